# SPDX-License-Identifier: MIT
"""What a training set is worth: one small network that completes the depth of a single sweep,
trained from the same weights on maps accumulated rigidly (ICP) and on maps with scene flow, tested
on the exact depth of another street.

python examples/train_completion.py [--data SPEC] [--test SPEC] [--keys A:B:S] [--steps N] ...
"""

import argparse
import copy
import sys
from itertools import islice, pairwise
from pathlib import Path

import torch
from torch import nn
from torch.nn.functional import avg_pool2d, interpolate, max_pool2d
from torch.utils.data import DataLoader

import densify
from densify.scores.depth_metrics import depth_errors, mean_errors

HEIGHT_PX, CROP_PX, FULL_PX = 256, (256, 384), (256, 1242)  # rows that the lidar reaches
CAMERA = "image_02"


def make_set(data, method, keys, out, window):
    """Run again, it makes only what is not there yet."""
    print(f"making {out}", file=sys.stderr, flush=True)
    recipe = densify.Recipe(window=window, method=method, cameras=(CAMERA,))
    densify.make_dataset([data], out, slice(*map(int, keys.split(":"))), recipe)
    return out


def interpolated(sparse_log):
    """(N,1,H,W) log depth, 0 none -> the same without holes: each filled by the smallest square of
    a pyramid that holds a return."""
    weight = (sparse_log > 0).float()
    levels = [(sparse_log, weight)]
    while max(levels[-1][0].shape[2:]) > 1:
        levels.append(tuple(avg_pool2d(x, 2, ceil_mode=True) for x in levels[-1]))
    dense = 0.0 * levels[-1][0]
    for value, weight in reversed(levels):
        coarser = interpolate(dense, value.shape[2:], mode="bilinear")
        dense = torch.where(weight > 0, value / weight.clamp(min=1e-9), coarser)
    return dense


def choices(sparse_log):
    """(N,1,H,W) log depth, 0 none -> (N,5,H,W) what the pixel may show: interpolated, and the
    nearest and the farthest return of two neighbourhoods."""
    base = interpolated(sparse_log)
    there, layers = sparse_log > 0, [base]
    for size in (7, 15):
        for sign in (-1, 1):
            most = max_pool2d(torch.where(there, sign * sparse_log, -99.0), size, 1, size // 2)
            layers.append(torch.where(most > -99, sign * most, base))
    return torch.cat(layers, 1)


def conv(inputs, outputs, stride=1):
    layer = nn.Conv2d(inputs, outputs, 3, stride, 1)
    nn.init.kaiming_normal_(layer.weight, 0.1)
    return nn.Sequential(layer, nn.LeakyReLU(0.1))


class Completion(nn.Module):
    """A small U-Net at half the resolution, which weighs what a pixel may show."""

    def __init__(self, widths=(16, 24, 32, 32)):
        super().__init__()
        levels = list(pairwise(widths))
        self.first = conv(3 + 5 + 1, widths[0])
        self.down = nn.ModuleList(conv(a, b, 2) for a, b in levels)
        self.up = nn.ModuleList(conv(b + a, a) for a, b in levels)
        self.last = nn.Conv2d(widths[0], 5 + 1, 3, 1, 1)
        nn.init.zeros_(self.last.weight)
        with torch.no_grad():  # untrained, it interpolates
            self.last.bias.copy_(torch.tensor([4.0, 0, 0, 0, 0, 0]))

    def forward(self, image, sparse_m):
        """(N,3,H,W), (N,1,H,W) -> (N,1,H,W) metres."""
        sparse_log = (sparse_m + 1e-3).clamp(min=1.0).log()  # 0 none: all returns are beyond 1 m
        half_log = max_pool2d(torch.where(sparse_log > 0, -sparse_log, -99.0), 2, ceil_mode=True)
        half_log = torch.where(half_log > -99, -half_log, 0.0)
        depths = choices(half_log)
        colours = interpolate(image, half_log.shape[2:], mode="area") - 0.5
        shifts = depths[:, 1:] - depths[:, :1]
        x = self.first(torch.cat([colours, depths[:, :1] / 4, shifts, (half_log > 0).float()], 1))
        skips = []
        for down in self.down:
            skips.append(x)
            x = down(x)
        for up, skip in zip(reversed(self.up), reversed(skips), strict=True):
            x = up(torch.cat([interpolate(x, skip.shape[2:], mode="bilinear"), skip], 1))
        x = self.last(x)
        log_m = (x[:, :5].softmax(1) * depths).sum(1, keepdim=True) + x[:, 5:]
        return interpolate(log_m, image.shape[2:], mode="bilinear").clamp(0, 5).exp()


def batches(dataset, seed):
    """For ever; every epoch in another order, and cut and mirrored anew."""
    order = torch.Generator().manual_seed(seed)
    loader = DataLoader(dataset, 4, shuffle=True, generator=order)
    while True:
        yield from loader


def trained(network, folder, steps, seed, filled):
    """A copy of the network after some steps on the maps of a set."""
    torch.manual_seed(seed)  # of the crops and flips
    network = copy.deepcopy(network).train()
    dataset = densify.DepthDataset(folder, filled=filled, crop=CROP_PX, flip=True)
    optimiser = torch.optim.Adam(network.parameters())
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 6e-3, total_steps=steps)
    for batch in islice(batches(dataset, seed), steps):
        target_m = batch["dense_depth_m"]
        ratio = network(batch["image"], batch["sparse_depth_m"]) / target_m.clamp(min=1.0)
        loss = ratio[target_m > 0].log().abs().mean()
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return network.eval()


@torch.no_grad()
def errors(network, folder, truth):
    """`densify.scores.depth_metrics` of all, moving and static pixels, mean of the images."""
    parts = {"all": [], "moving": [], "static": []}
    for sample in densify.DepthDataset(folder, crop=FULL_PX):
        where = sample["camera"], sample["frame"]
        truth_m = truth.depth_m(*where)[-HEIGHT_PX:]
        moving = truth.moving_mask(*where)[-HEIGHT_PX:]
        depth_m = network(sample["image"][None], sample["sparse_depth_m"][None])[0, 0].numpy()
        focal_px = float(sample["intrinsics"][0, 0])
        for part, mask in (("all", None), ("moving", moving), ("static", ~moving)):
            parts[part].append(depth_errors(depth_m, truth_m, mask, focal_px=focal_px))
    return {part: mean_errors(images) for part, images in parts.items()}


def row(name, scores):
    cells = [
        f"{e.mae_m:6.3f} {e.rmse_m:6.3f} {e.outliers:7.2%}" if e.num_compared else " " * 21
        for e in scores.values()
    ]
    return f"{name:<14}" + "  ".join(f"{cell:>23}" for cell in cells)


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", default="street", help="a street to train on")
    parser.add_argument("--test", default="street?seed=1", help="another one to test on")
    parser.add_argument("--keys", default="40:120:4", help="to train on")
    parser.add_argument("--test-keys", default="60:100:5")
    parser.add_argument("--window", type=int, default=5, help="sweeps on each side of a key")
    parser.add_argument("--steps", type=int, default=150)
    parser.add_argument("--seeds", type=int, default=1, help="how often, from other weights")
    parser.add_argument("--filled", action="store_true", help="train on interpolated pixels too")
    parser.add_argument("--out", type=Path, default=Path("completion"))
    options = parser.parse_args()

    sets = {
        method: make_set(options.data, method, options.keys, options.out / method, options.window)
        for method in ("icp", "flow")
    }
    test = make_set(options.test, "none", options.test_keys, options.out / "test", 1)
    truth = densify.open_sequence(options.test).truth
    print(f"{'':14}{'all':^23}  {'moving':^23}  {'static':^23}")
    print(f"{'trained on':<14}" + "  ".join([f"{'MAE m  RMSE m outliers':>23}"] * 3))
    for seed in range(options.seeds):
        torch.manual_seed(seed)
        network = Completion()
        if seed == 0:
            print(row("nothing", errors(network.eval(), test, truth)), flush=True)
        for method, folder in sets.items():
            after = trained(network, folder, options.steps, seed, options.filled)
            print(row(f"{method}, seed {seed}", errors(after, test, truth)), flush=True)


if __name__ == "__main__":
    main()
