# SPDX-License-Identifier: MIT
"""Draw every picture of the README and of docs/.

python docs/make_pictures.py [NAME…] [--pandaset DIR] [--runs DIR]

NAME: pandaset, street, how, set, reports, paper, notebook (default: all). Each key is densified
once, into RUNS (default: ./densify-out/pictures). Finished runs there are drawn again as they are.
pandaset needs --pandaset, the folder of sequence 002; set needs Chromium.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import explained_scene
import matplotlib
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from scipy import ndimage

from densify.cli import main as densify
from densify.outputs import report_page
from densify.outputs.cloud_files import read_cloud
from densify.outputs.depth_png import read_stored
from densify.scores.metrics import is_outlier_depth

DOCS = Path(__file__).resolve().parent
PICTURES, REPORTS = DOCS / "pictures", DOCS / "reports"
NOTEBOOK = DOCS.parent / "examples" / "your_data.ipynb"
NUMBERS = PICTURES / "numbers.json"

NEAR_M, FAR_M = 4.0, 80.0
DARK, LIGHT, TITLE_PX = (24, 26, 32), (235, 235, 235), 36
MOST_BYTES, MOST_VIDEO_BYTES, MOST_REPORT_BYTES = 250_000, 1_500_000, 3_000_000
REPORT_POINTS = 140_000
AHEAD_M, BESIDE_M, CELL_M = (-10.0, 62.0), 15.0, 0.08  # what a cloud shows

Picture = NDArray[np.uint8]


class Key(NamedTuple):
    """A key of the gallery. spec: "PANDASET" stands for the folder that is given."""

    name: str
    spec: str
    key: int
    camera: str = "image_02"
    window: int = 5

    def run(self, runs: Path, pandaset: Path | None) -> Path:
        """Return the folder of the finished run, made if it is not there."""
        folder = runs / self.name / f"{self.key:06d}"
        if not (folder / "metrics.json").is_file():
            spec = self.spec.replace("PANDASET", f"pandaset:{pandaset}")
            options = ["--key", str(self.key), "--camera", self.camera, "--score", "--overwrite"]
            options += ["--window", str(self.window)]
            # A process of its own, for the seconds and the memory that a user has.
            command = [sys.executable, "-m", "densify", "run", spec, *options]
            if subprocess.run([*command, "--out", str(folder.parent)]).returncode:
                raise SystemExit(f"{self}: densify run failed; its message is above")
        return folder


PANDASET = (
    Key("pandaset-front-11", "PANDASET", 11, "front_camera"),
    Key("pandaset-front-17", "PANDASET", 17, "front_camera"),
    Key("pandaset-left-13", "PANDASET", 13, "left_camera"),
    Key("pandaset-left-21", "PANDASET", 21, "left_camera"),
)
HERO = PANDASET[0]
OPENING = tuple(HERO._replace(name=f"{HERO.name}-window-{n}", window=n) for n in range(1, 6))
STREETS = (
    Key("street", "street", 120),
    Key("crossing", "street:crossing", 120),
    Key("highway", "street:highway", 120),
    Key("sixteen-rings", "street?seed=46&sensor=vlp16", 80),
)


def depth_m(folder: Path, place: str, camera: str) -> NDArray[np.float64]:
    """Return (H,W) metres of a stored map, 0 none."""
    return read_stored(folder / place / f"{camera}.png", np.uint16, "a depth map") / 256


def coloured(depth: NDArray[np.float64], spot_px: int = 1) -> Picture:
    """Return (H,W,3): near red, far blue, logarithmic. A depth covers ``spot_px`` squared."""
    nearest = np.where(depth > 0, depth, np.inf)
    nearest = ndimage.minimum_filter(nearest, spot_px)
    known = np.isfinite(nearest)
    level = np.log(np.where(known, nearest, 1) / NEAR_M) / math.log(FAR_M / NEAR_M)
    table = (matplotlib.colormaps["turbo_r"](np.arange(256))[:, :3] * 255).astype(np.uint8)
    shown = table[(np.clip(level, 0, 1) * 255).astype(int)]
    return np.where(known[..., None], shown, np.uint8(DARK))


def grey(values: NDArray[Any]) -> Picture:
    """Return (H,W,3) of values from 0 to 255."""
    return np.repeat(values.astype(np.uint8)[..., None], 3, axis=2)


def titled(picture: Picture, title: str, width_px: int) -> Picture:
    """Return the picture at that width, below its title."""
    height_px = round(picture.shape[0] * width_px / picture.shape[1])
    shrinks = width_px < picture.shape[1]
    how = cv2.INTER_AREA if shrinks else cv2.INTER_NEAREST
    resized = cv2.resize(picture, (width_px, height_px), interpolation=how)
    canvas = Image.new("RGB", (width_px, height_px + TITLE_PX), DARK)
    font_file = Path(matplotlib.get_data_path()) / "fonts/ttf/DejaVuSans.ttf"
    font = ImageFont.truetype(str(font_file), TITLE_PX // 2 + 2)
    ImageDraw.Draw(canvas).text((8, 6), title, LIGHT, font)
    canvas.paste(Image.fromarray(resized), (0, TITLE_PX))
    return np.asarray(canvas)


def tiled(panels: Sequence[Picture], columns: int) -> Picture:
    """Return panels of one size in rows of so many."""
    rows = [np.hstack(panels[i : i + columns]) for i in range(0, len(panels), columns)]
    return np.vstack(rows)


def write(name: str, picture: Picture) -> None:
    """Write PICTURES/NAME.webp, as good as its size allows."""
    PICTURES.mkdir(exist_ok=True)
    path = PICTURES / f"{name}.webp"
    for quality in (90, 80, 70, 60, 50, 40):
        Image.fromarray(picture).save(path, quality=quality, method=6)
        if path.stat().st_size <= MOST_BYTES:
            print(f"{path.relative_to(DOCS.parent)}  {path.stat().st_size // 1000} kB")
            return
    raise SystemExit(f"{path}: larger than {MOST_BYTES} bytes at any quality; draw it smaller")


def scores(folder: Path, camera: str) -> dict[str, dict[str, float | None]]:
    """Return method -> density and outliers, of the truth if there is one, else held out."""
    metrics = json.loads((folder / "metrics.json").read_text())
    found: dict[str, dict[str, float | None]] = {}
    for method, own in {**metrics["baselines"], "flow": metrics}.items():
        against = (own.get("depth") or own.get("held_out") or {}).get(camera, {})
        for product in ("measured", "filled") if method == "flow" else ("measured",):
            of_all, of_moving = (against.get(product, {}).get(p, {}) for p in ("all", "moving"))
            found[f"{method} {product}"] = {
                "density": own["density"][camera][product],
                "coverage": of_all.get("coverage"),
                "outliers": of_all.get("outliers"),
                "coverage_moving": of_moving.get("coverage"),
                "outliers_moving": of_moving.get("outliers"),
            }
    return found


def percent(share: float | None) -> str:
    """Return a share for a title."""
    if share is None:
        return "–"
    return f"{100 * share:.1f} %" if share >= 0.01 else f"{100 * share:.2f} %"


def title(name: str, numbers: Mapping[str, float | None]) -> str:
    """Return a panel's title with its numbers."""
    text = f"{name}: {percent(numbers['density'])} of pixels"
    if numbers["outliers"] is not None:
        text += f", {percent(numbers['outliers'])} outliers"
    return text


def panels(folder: Path, camera: str, width_px: int) -> list[Picture]:
    """Return single sweep, rigid accumulation, and the measured and filled map."""
    numbers = scores(folder, camera)
    spot_px = 3 if width_px < 1000 else 2
    rows = (
        ("single sweep", "none measured", "scene/none", spot_px),
        ("rigid accumulation", "icp measured", "scene/icp", spot_px),
        ("densify, measured", "flow measured", "depth", 1),
        ("densify, filled", "flow filled", "depth_filled", 1),
    )
    return [
        titled(coloured(depth_m(folder, place, camera), spot), title(name, numbers[key]), width_px)
        for name, key, place, spot in rows
    ]


def from_above(folder: Path, width_px: int) -> list[Picture]:
    """Return the cloud from above, rigid and moved; moving points are orange."""
    cloud = read_cloud(folder / "cloud.laz")
    drawn = []
    for name, points in (("rigid", cloud.rigid_points), ("densify", cloud.points)):
        x, y, z = points.T
        row, column = ((BESIDE_M - y) / CELL_M).astype(int), ((x - AHEAD_M[0]) / CELL_M).astype(int)
        shape = (round(2 * BESIDE_M / CELL_M), round((AHEAD_M[1] - AHEAD_M[0]) / CELL_M))
        inside = (row >= 0) & (row < shape[0]) & (column >= 0) & (column < shape[1]) & (z < 3)
        rows = np.flatnonzero(inside & (~cloud.far | ~cloud.moving))
        rows = rows[np.lexsort((z[rows], cloud.moving[rows]))]  # moving ones last: on top
        height = np.clip((z[rows] - np.percentile(z[rows], 2)) / 4, 0, 1)
        colours = (70 + 150 * height)[:, None].repeat(3, axis=1)
        colours[cloud.moving[rows]] = (255, 140, 0)
        picture = np.full((*shape, 3), DARK, np.uint8)
        picture[row[rows], column[rows]] = colours
        drawn.append(titled(picture, f"cloud from above, {name}", width_px))
    return drawn


def worst_place(folder: Path, camera: str) -> Picture:
    """Return the largest cluster of outliers of the filled map: true depth, map, outliers."""
    true_m, map_m = (depth_m(folder, place, camera) for place in ("scene/truth", "depth_filled"))
    focal_px = json.loads((folder / "scene/scene.json").read_text())["views"][camera]["K"][0][0]
    wrong = (true_m > 0) & (map_m > 0)
    wrong[wrong] = is_outlier_depth(map_m[wrong], true_m[wrong], focal_px)
    label, _ = ndimage.label(ndimage.binary_dilation(wrong, iterations=4))
    sizes = np.bincount(label[wrong], minlength=2)
    sizes[0] = 0
    v, u = np.nonzero(wrong & (label == sizes.argmax()))
    height, width = true_m.shape
    half_v, half_u = 70, 140
    top = int(np.clip(np.median(v) - half_v, 0, height - 2 * half_v)) if len(v) else 0
    left = int(np.clip(np.median(u) - half_u, 0, width - 2 * half_u)) if len(u) else 0
    box = (slice(top, top + 2 * half_v), slice(left, left + 2 * half_u))
    red = coloured(map_m) // 3
    red[wrong] = (255, 60, 60)
    shown = (coloured(true_m)[box], coloured(map_m)[box], red[box])
    names = ("true depth", "densify, filled", "its outliers in red")
    return np.hstack([titled(p, n, 420) for p, n in zip(shown, names, strict=True)])


def remember(name: str, numbers: Mapping[str, Any]) -> None:
    """Keep the numbers of a picture's titles, for the tests."""
    known = json.loads(NUMBERS.read_text()) if NUMBERS.is_file() else {}
    known[name] = {
        method: {k: None if v is None else round(v, 5) for k, v in row.items()}
        for method, row in numbers.items()
    }
    NUMBERS.write_text(json.dumps(dict(sorted(known.items())), indent=1) + "\n")


def image_and_confidence(folder: Path, camera: str, width_px: int) -> list[Picture]:
    """Return the image of the camera, and the confidence of the filled map."""
    image = np.asarray(Image.open(folder / f"scene/image/{camera}.jpg").convert("RGB"))
    confidence = read_stored(folder / f"confidence/{camera}.png", np.uint8, "a confidence")
    shown = (image, "image"), (grey(confidence), "confidence")
    return [titled(picture, name, width_px) for picture, name in shown]


def draw_key(key: Key, folder: Path) -> None:
    """Draw a key of the gallery; PandaSet's without its photographs."""
    maps, clouds = panels(folder, key.camera, 700), from_above(folder, 700)
    if key in STREETS:
        image, confidence = image_and_confidence(folder, key.camera, 700)
        maps = [image, *maps, confidence]
    write(f"gallery-{key.name}", tiled([*maps, *clouds], 2))
    remember(key.name, scores(folder, key.camera))


def make_pandaset(runs: Path, pandaset: Path | None) -> None:
    """Draw the keys of PandaSet, and the picture of the README."""
    if pandaset is None:
        raise SystemExit("pandaset: --pandaset DIR is missing, the folder of sequence 002")
    for key in PANDASET:
        draw_key(key, key.run(runs, pandaset))
    write_opening([key.run(runs, pandaset) for key in OPENING])


def num_sweeps_of(folder: Path) -> int:
    """Return the number of sweeps in the window of a run."""
    return len(json.loads((folder / "scene/scene.json").read_text())["sweeps"])


def write_opening(folders: Sequence[Path]) -> None:
    """Write the animation of the README: the whole window, then how it opens.

    Both maps are measured, not filled, and each depth covers 3 x 3 pixels.
    """
    first = folders[0], "scene/none", "scene/none", 1
    opened = [(folder, "scene/icp", "depth", num_sweeps_of(folder)) for folder in folders]
    frames = []
    for folder, rigid, ours, num_sweeps in [first, *opened]:
        shown = []
        for name, place in (("rigid accumulation", rigid), ("densify", ours)):
            picture = coloured(depth_m(folder, place, HERO.camera), 3)
            rows = slice(round(0.42 * len(picture)), round(0.86 * len(picture)))
            sweeps = f"{num_sweeps} sweep{'s' * (num_sweeps > 1)}"
            shown.append(titled(picture[rows], f"{name}, {sweeps}, measured", 1000))
        frames.append(Image.fromarray(np.vstack(shown)))
    frames = [frames[-1], *frames[:-1]]  # a still picture shows the whole window
    path, times_ms = PICTURES / "pandaset.webp", [2500] + [900] * (len(frames) - 1)
    frames[0].save(
        path, save_all=True, append_images=frames[1:], duration=times_ms, loop=0, quality=70
    )
    if path.stat().st_size > MOST_VIDEO_BYTES:
        raise SystemExit(f"{path}: larger than {MOST_VIDEO_BYTES} bytes; draw it smaller")


def make_street(runs: Path, pandaset: Path | None) -> None:
    """Draw the keys of the street, what comes out of one, and the worst place of each."""
    worst = []
    for key in STREETS:
        draw_key(key, folder := key.run(runs, None))
        worst.append(worst_place(folder, key.camera))
        if key is STREETS[0]:
            image, confidence = image_and_confidence(folder, key.camera, 700)
            maps = panels(folder, key.camera, 700)[2:]
            write("outputs", tiled([image, *maps, confidence], 2))
    write("limits", np.vstack(worst))


def make_how(runs: Path, pandaset: Path | None) -> None:
    """Draw the pictures at the beginning of how-it-works: evidence, rays, hulls."""
    found = explained_scene.explained()
    maps = (coloured(depth_m) for depth_m in (found.depth.depth_m, found.depth.filled_m))
    write("how-evidence", explained_scene.evidence_picture(found))
    write("how-rays", explained_scene.rays_picture(found))
    write("how-hull", explained_scene.hull_picture(found, *maps))


def make_set(runs: Path, pandaset: Path | None) -> None:
    """Draw the top of the page of a training set, as a browser shows it."""
    browser = shutil.which("chromium") or shutil.which("chromium-browser")
    if browser is None:
        raise SystemExit("set: chromium: not found; expected a browser that takes screenshots")
    folder, screenshot = (runs / "street-dense").resolve(), (runs / "set.png").resolve()
    options = ["--keys", "110:126", "--camera", "image_02", "--set", "output.score=true"]
    if densify(["dataset", "street", *options, "--workers", "1", "--out", str(folder)]):
        raise SystemExit("densify dataset failed; its message is above")
    if densify(["report", str(folder), "--overwrite"]):
        raise SystemExit("densify report failed; its message is above")
    command = [browser, "--headless", "--no-sandbox", "--hide-scrollbars"]
    command += [f"--screenshot={screenshot}", "--window-size=1200,1330"]
    subprocess.run([*command, (folder / "report.html").as_uri()], check=True)
    write("set", np.asarray(Image.open(screenshot).convert("RGB")))


def make_reports(runs: Path, pandaset: Path | None) -> None:
    """Write two pages to turn around, with fewer points than `densify report` has."""
    report_page._MOST_POINTS = REPORT_POINTS
    REPORTS.mkdir(exist_ok=True)
    for key in STREETS[:2]:
        folder = key.run(runs, None)
        if densify(["report", str(folder), "--overwrite"]):
            raise SystemExit(f"{folder}: densify report failed; its message is above")
        page = shutil.copy(folder / "report.html", REPORTS / f"{key.name}.html")
        size = Path(page).stat().st_size
        print(f"{page}  {size // 1000} kB")
        if size > MOST_REPORT_BYTES:
            raise SystemExit(f"{page}: larger than {MOST_REPORT_BYTES} bytes; take fewer points")


def make_paper(runs: Path, pandaset: Path | None) -> None:
    """Draw the paper's Figure 1 on the built-in street."""
    folder, camera = runs / "paper" / "000120", "image_02"
    if not (folder / "compare.json").is_file():
        methods = ["--key", "120", "--methods", "none,icp,paper,flow", "--camera", camera]
        if densify(["compare", "street", *methods, "--out", str(folder.parent), "--overwrite"]):
            raise SystemExit("densify compare failed; its message is above")
    compared = json.loads((folder / "compare.json").read_text())["methods"]
    shown = []
    for method, name, spot_px in (
        ("none", "single sweep", 3),
        ("icp", "rigid accumulation", 3),
        ("paper", "the published flow", 1),
        ("flow", "densify", 1),
    ):
        place = "compare/depth" if method == "flow" else f"compare/scene/{method}"
        score = compared[method]
        numbers = {
            "density": score["density"][camera]["measured"],
            "outliers": score["depth"][camera]["measured"]["all"]["outliers"],
        }
        remember(f"paper {method}", {"measured": numbers})
        picture = coloured(depth_m(folder, place, camera), spot_px)
        shown.append(titled(picture, title(name, numbers), 900))
    write("paper", np.vstack(shown))


def make_notebook(runs: Path, pandaset: Path | None) -> None:
    """Run the notebook and keep its output."""
    import nbformat
    from nbclient import NotebookClient

    notebook = nbformat.read(NOTEBOOK, as_version=4)
    folder = runs / "notebook"
    folder.mkdir(parents=True, exist_ok=True)
    NotebookClient(notebook, timeout=1200, resources={"metadata": {"path": str(folder)}}).execute()
    for cell in notebook.cells:
        cell.metadata.pop("execution", None)
        if cell.cell_type == "code":  # without progress and log
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
            for output in cell.outputs:
                output.get("data", {}).pop("image/jpeg", None)
    nbformat.write(notebook, NOTEBOOK)


MAKERS = {
    "pandaset": make_pandaset,
    "street": make_street,
    "how": make_how,
    "set": make_set,
    "reports": make_reports,
    "paper": make_paper,
    "notebook": make_notebook,
}


def main() -> None:
    """Read the arguments and make what is asked for."""
    about, usage, *_ = (__doc__ or "").split("\n\n")
    parser = argparse.ArgumentParser(description=about, usage=usage)
    parser.add_argument("names", nargs="*", choices=[*MAKERS, []], metavar="NAME")
    parser.add_argument("--pandaset", type=Path)
    parser.add_argument("--runs", type=Path, default=Path("densify-out/pictures"))
    options = parser.parse_args()
    pandaset = options.pandaset and options.pandaset.resolve()
    options.runs.mkdir(parents=True, exist_ok=True)
    os.chdir(options.runs)  # pages and pictures name places from there
    for name in options.names or MAKERS:
        MAKERS[name](Path(), pandaset)


if __name__ == "__main__":
    main()
