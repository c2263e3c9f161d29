// SPDX-License-Identifier: MIT
// The maps of one camera over its image: two layers with a divider, what is under the pointer, and
// what a least confidence and a greatest age leave.

const M_PER_STEP = 1 / 256;
const DECADES = 5; // confidence c: one pixel in 10^(5c) is an outlier
const BASELINE_M = 0.54, WRONG_PX = 3, WRONG_SHARE = 0.05; // KITTI's rule
const METHOD_NAMES = {
  none: "single sweep",
  icp: "rigid accumulation",
  "icp-far": "rigid accumulation, with sweeps beyond the window",
  flow: "scene flow",
  depth_full: "scene flow, completed with the prior",
};
const methodName = (name) => METHOD_NAMES[name] || name;

// A camera's maps, unpacked.
class CameraMaps {
  static async of(name, entry) {
    const maps = Object.assign(new CameraMaps(), { name, entry, others: {} });
    [maps.height, maps.width] = entry.filled.shape;
    maps.size = maps.width * maps.height;
    maps.filled = await unpack(entry.filled);
    maps.source = await unpack(entry.source);
    for (const kind of ["confidence", "reason", "truth"]) {
      if (entry[kind]) maps[kind] = await unpack(entry[kind]);
    }
    for (const [method, packed] of Object.entries(entry.others)) {
      maps.others[method] = await unpack(packed);
    }
    maps.gray = new Uint8ClampedArray(4 * maps.size).fill(18);
    maps.photo = maps.gray.slice();
    if (entry.image) maps.takeImage(await unpackImage(entry.image));
    for (let i = 3; i < maps.gray.length; i += 4) maps.gray[i] = maps.photo[i] = 255;
    maps.oldestMs = entry.sources.reduce((most, [, age]) => Math.max(most, age - 1), 0);
    return maps;
  }
  takeImage(image) {
    const canvas = element("canvas", { width: this.width, height: this.height });
    const c = canvas.getContext("2d", { willReadFrequently: true });
    c.drawImage(image, 0, 0, this.width, this.height);
    this.photo = c.getImageData(0, 0, this.width, this.height).data;
    for (let i = 0; i < this.photo.length; i += 4) {
      const [r, g, b] = [this.photo[i], this.photo[i + 1], this.photo[i + 2]];
      this.gray.fill(0.45 * (0.299 * r + 0.587 * g + 0.114 * b), i, i + 3);
    }
  }
  sourceAt(i) {
    const [sweep, age, measured] = this.entry.sources[this.source[i]];
    return { sweep: page.sweeps[sweep - 1], ageMs: age ? age - 1 : null, measured: !!measured };
  }
  // 1 where a pixel is as certain and fresh as asked, by pixel.
  kept(minConfidence, maxAgeMs) {
    const least = minConfidence > 0 ? 1 + Math.round(254 * minConfidence) : 0;
    const fresh = this.entry.sources.map(([, age]) => (age - 1 <= maxAgeMs ? 1 : 0));
    const kept = new Uint8Array(this.size);
    for (let i = 0; i < this.size; i++) {
      kept[i] = this.filled[i] && fresh[this.source[i]] && (!this.confidence || this.confidence[i] >= least) ? 1 : 0;
    }
    return kept;
  }
  isWrong(depth, truth) {
    const most = (this.entry.focal_px || 721.5377) * BASELINE_M / M_PER_STEP;
    const off = Math.abs(most / depth - most / truth);
    return off > WRONG_PX && off > WRONG_SHARE * most / truth;
  }
  // Density, the outliers that confidence expects, and against the truth, of measured and filled.
  statistics(kept) {
    const measuredOf = this.entry.sources.map(([, , measured]) => measured);
    const chance = Array.from({ length: 256 }, (_, level) => 10 ** (-DECADES * (level - 1) / 254));
    const rows = ["measured", "filled"].map((product) => ({ product, num: 0, expected: 0, compared: 0, wrong: 0, off: 0 }));
    for (let i = 0; i < this.size; i++) {
      if (!kept[i]) continue;
      for (let r = measuredOf[this.source[i]] ? 0 : 1; r < 2; r++) {
        rows[r].num++;
        if (this.confidence) rows[r].expected += chance[this.confidence[i]];
        if (this.truth && this.truth[i]) {
          rows[r].compared++;
          rows[r].off += Math.abs(this.filled[i] - this.truth[i]);
          rows[r].wrong += this.isWrong(this.filled[i], this.truth[i]) ? 1 : 0;
        }
      }
    }
    return rows.map((r) => ({
      product: r.product,
      density: r.num / this.size,
      expected: this.confidence && r.num ? r.expected / r.num : null,
      isFew: r.compared > 0 && r.compared < page.least_pixels,
      outliers: r.compared >= page.least_pixels ? r.wrong / r.compared : null,
      maeM: r.compared >= page.least_pixels ? (r.off / r.compared) * M_PER_STEP : null,
    }));
  }
  // [[name, text], ...] of what can be looked at.
  layers() {
    const list = [["image", "image"]];
    for (const method of Object.keys(this.others)) list.push([method, methodName(method)]);
    const ours = methodName(page.method);
    list.push(["measured", `${ours}: measured`], ["filled", `${ours}: filled`]);
    if (this.confidence) list.push(["confidence", "confidence"]);
    if (this.oldestMs || this.entry.sources.some(([, age]) => age)) list.push(["age", "age"]);
    if (this.entry.sources.some(([sweep]) => sweep)) list.push(["sweep", "source sweep"]);
    if (this.reason) list.push(["reason", "rejected points, and why"]);
    if (this.truth) list.push(["truth", "truth"], ["error", "error against the truth"]);
    return this.entry.image ? list : list.slice(1);
  }
}

const depthScale = (palette) =>
  new Scale({ low: 3, high: 80, log: true, reverse: true, palette, unit: "m", ticks: [3, 5, 10, 20, 40, 80] });
const errorScale = () =>
  new Scale({ low: 0.02, high: 10, log: true, palette: "inferno", unit: "m", ticks: [0.02, 0.1, 0.5, 2, 10] });
const confidenceScale = () =>
  new Scale({ low: 0, high: 1, palette: "cividis", unit: "", ticks: [0, 0.25, 0.5, 0.75, 1] });
const ageScale = (maps) =>
  new Scale({ low: 0, high: Math.max(maps.oldestMs, 1), palette: "viridis", reverse: true, unit: "ms",
    ticks: [0, 0.25, 0.5, 0.75, 1].map((s) => Math.round(s * Math.max(maps.oldestMs, 1))) });

function nearestAround(depth, width, height) {
  const along = new Uint16Array(depth.length), nearest = new Uint16Array(depth.length);
  const nearer = (a, b) => (a && (!b || a < b) ? a : b);
  for (let i = 0; i < depth.length; i++) {
    const x = i % width;
    along[i] = nearer(x ? depth[i - 1] : 0, nearer(depth[i], x < width - 1 ? depth[i + 1] : 0));
  }
  for (let i = 0; i < depth.length; i++) {
    nearest[i] = nearer(i >= width ? along[i - width] : 0, nearer(along[i], i + width < depth.length ? along[i + width] : 0));
  }
  return nearest;
}

// The pixels of a layer: {rgba, legend, density}.
function drawLayer(maps, layer, kept, palette, enlarge) {
  if (layer === "image") return { rgba: maps.photo.slice(), legend: null, density: null };
  const rgba = maps.gray.slice();
  const put = (i, r, g, b) => { rgba[4 * i] = r; rgba[4 * i + 1] = g; rgba[4 * i + 2] = b; };
  const putEach = (levels, table) => {
    for (let i = 0; i < maps.size; i++) {
      if (levels[i]) put(i, table[3 * levels[i]], table[3 * levels[i] + 1], table[3 * levels[i] + 2]);
    }
  };
  if (layer === "reason") {
    for (let i = 0; i < maps.size; i++) {
      const reason = REASONS[maps.reason[i]];
      if (reason) put(i, ...reason[1]);
    }
    return { rgba, legend: { title: "nearest point left out of the pixel", marks: Object.values(REASONS) }, density: null };
  }
  if (layer === "confidence") {
    const table = confidenceScale().table(255, 1 / 254), levels = maps.confidence.map((v, i) => v * kept[i]);
    putEach(levels, table);
    return { rgba, legend: { title: "confidence c: one pixel in 10^(5c) is an outlier", scale: confidenceScale() } };
  }
  if (layer === "age" || layer === "sweep") {
    const mostS = Math.max(...page.sweeps.map((s) => Math.abs(s.since_key_s) || 0), 0.1);
    const colours = maps.entry.sources.map(([sweep, age]) => {
      if (layer === "age") return age ? ageScale(maps).colour(age - 1) : null;
      return sweep && page.sweeps[sweep - 1] ? timeColour(page.sweeps[sweep - 1].since_key_s || 0, mostS) : null;
    });
    for (let i = 0; i < maps.size; i++) {
      const colour = kept[i] && colours[maps.source[i]];
      if (colour) put(i, ...colour);
    }
    if (layer === "age") return { rgba, legend: { title: "between the exposure and the sweep that measured", scale: ageScale(maps) } };
    return { rgba, legend: { title: "sweep that measured the pixel", marks: timeMarks(mostS) } };
  }
  let depth = layer === "truth" ? maps.truth : maps.others[layer];
  if (!depth) {
    const every = layer !== "measured", measuredOf = maps.entry.sources.map(([, , measured]) => measured);
    depth = maps.filled.map((v, i) => (kept[i] && (every || measuredOf[maps.source[i]]) ? v : 0));
  }
  if (layer === "error") {
    const table = errorScale().table(255 * 16, 1 / 256);
    for (let i = 0; i < maps.size; i++) {
      if (!depth[i] || !maps.truth[i]) continue;
      const at = 3 * Math.min(Math.abs(depth[i] - maps.truth[i]), 255 * 16);
      put(i, table[at], table[at + 1], table[at + 2]);
    }
    return { rgba, legend: { title: "distance of the filled depth from the truth", scale: errorScale() } };
  }
  let known = 0;
  for (let i = 0; i < maps.size; i++) known += depth[i] ? 1 : 0;
  const single = layer === "measured" || (layer in maps.others && layer !== "depth_full");
  const shown = enlarge && single ? nearestAround(depth, maps.width, maps.height) : depth;
  const scale = depthScale(palette);
  putEach(shown, scale.table(65535, M_PER_STEP));
  return { rgba, legend: { title: "depth", scale }, density: known / maps.size };
}

function timeMarks(mostS) {
  const times = [-mostS, -mostS / 4, 0, mostS / 4, mostS];
  return times.map((s) => [s ? signed(s, 1, "s") : "the key sweep", timeColour(s, mostS)]);
}

// The section: its state is the choices, the divider and the pointer.
class ImagePane {
  constructor(names) {
    this.names = names;
    this.at = null;
    this.drawing = false;
    fillSelect($("camera"), names.map((n) => [n, n]));
    fillSelect($("palette"), [["turbo", "red to blue (turbo)"], ["viridis", "viridis"], ["cividis", "cividis"]], "turbo");
    for (const id of ["left", "right", "palette", "enlarge"]) $(id).addEventListener("change", () => this.draw());
    for (const id of ["confidence", "age"]) $(id).addEventListener("input", () => this.soon());
    $("camera").addEventListener("change", () => section("The image", () => this.open($("camera").value)));
    $("split").addEventListener("input", () => this.compose());
    const picture = $("picture");
    picture.addEventListener("pointermove", (e) => this.point(e));
    picture.addEventListener("pointerdown", (e) => { picture.setPointerCapture(e.pointerId); this.point(e); });
    picture.addEventListener("keydown", (e) => this.key(e));
    addEventListener("resize", () => this.legends());
  }
  async open(name) {
    this.maps = await CameraMaps.of(name, page.cameras[name]);
    const layers = this.maps.layers(), has = (l) => layers.some(([n]) => n === l);
    const [left, right] = [$("left").value, $("right").value];
    fillSelect($("left"), layers, has(left) ? left : ["icp", "none"].find(has) || layers[0][0]);
    fillSelect($("right"), layers, has(right) ? right : "measured");
    const most = Math.max(this.maps.oldestMs, 1);
    const all = Number($("age").value) >= Number($("age").max) || !this.opened;
    $("age").max = most;
    if (all) $("age").value = most;
    this.opened = true;
    Object.assign($("picture"), { width: this.maps.width, height: this.maps.height });
    this.draw();
  }
  thresholds() {
    const all = Number($("age").value) >= Number($("age").max);
    return [Number($("confidence").value), all ? Infinity : Number($("age").value)];
  }
  soon() {
    if (this.drawing) return;
    this.drawing = true;
    requestAnimationFrame(() => { this.drawing = false; this.draw(); });
  }
  draw() {
    const maps = this.maps, [confidence, ageMs] = this.thresholds();
    this.kept = maps.kept(confidence, ageMs);
    this.sides = ["left", "right"].map((side) => {
      const layer = drawLayer(maps, $(side).value, this.kept, $("palette").value, $("enlarge").checked);
      const canvas = element("canvas", { width: maps.width, height: maps.height });
      canvas.getContext("2d").putImageData(new ImageData(layer.rgba, maps.width, maps.height), 0, 0);
      const text = maps.layers().find(([name]) => name === $(side).value)[1];
      $(`${side}-tag`).textContent = isNumber(layer.density) ? `${text}, ${percent(layer.density, 1)} of pixels` : text;
      return { canvas, legend: layer.legend };
    });
    this.legends();
    this.compose();
    this.tellKept(confidence, ageMs);
    if (this.at) this.read();
  }
  legends() {
    if (!this.sides) return;
    const [left, right] = this.sides.map((side) => side.legend);
    const other = JSON.stringify(left) === JSON.stringify(right) ? null : right;
    $("legend-left").hidden = !left; // both before either is measured
    $("legend-right").hidden = !other;
    drawLegend($("legend-left"), left);
    drawLegend($("legend-right"), other);
  }
  compose() {
    const share = Number($("split").value) / 100, c = $("picture").getContext("2d");
    const cut = Math.round(share * this.maps.width), { height } = this.maps;
    c.drawImage(this.sides[1].canvas, 0, 0);
    if (cut > 0) c.drawImage(this.sides[0].canvas, 0, 0, cut, height, 0, 0, cut, height);
    $("divider").style.left = `${100 * share}%`;
  }
  point(event) {
    const box = $("picture").getBoundingClientRect();
    const share = Math.min(Math.max((event.clientX - box.left) / box.width, 0), 1);
    if (event.buttons & 1) {
      $("split").value = 100 * share;
      this.compose();
    }
    const down = Math.min(Math.max((event.clientY - box.top) / box.height, 0), 1);
    this.at = [share * this.maps.width, down * this.maps.height].map(Math.floor);
    this.at = [Math.min(this.at[0], this.maps.width - 1), Math.min(this.at[1], this.maps.height - 1)];
    $("cross").hidden = true;
    this.read();
  }
  key(event) {
    const steps = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[event.key];
    if (!steps) return;
    event.preventDefault();
    const { width, height } = this.maps, by = event.shiftKey ? 10 : 1;
    const [x, y] = this.at || [width >> 1, height >> 1];
    this.at = [Math.min(Math.max(x + by * steps[0], 0), width - 1), Math.min(Math.max(y + by * steps[1], 0), height - 1)];
    $("cross").hidden = false;
    $("cross").style.left = `${(100 * (this.at[0] + 0.5)) / width}%`;
    $("cross").style.top = `${(100 * (this.at[1] + 0.5)) / height}%`;
    this.read();
  }
  read() {
    const maps = this.maps, [x, y] = this.at, i = y * maps.width + x;
    const { sweep, ageMs, measured } = maps.sourceAt(i), depth = maps.filled[i];
    const rows = [row("pixel", `u ${x}, v ${y}`)];
    const ours = methodName(page.method);
    const out = depth && !this.kept[i] ? " (below the sliders)" : "";
    rows.push(row(ours, depth ? `${metres(depth * M_PER_STEP)}, ${measured ? "measured" : "filled"}${out}` : "no depth"));
    if (depth) {
      if (sweep) rows.push(row("source sweep", `${sweep.frame} (${signed(sweep.since_key_s, 2, "s")} from the key)`));
      if (ageMs !== null) rows.push(row("age", `${ageMs} ms${measured ? "" : ", of the nearest measured pixel"}`));
      if (maps.confidence) {
        const c = (maps.confidence[i] - 1) / 254;
        rows.push(row("confidence", `${c.toFixed(2)}: one in ${whole(10 ** (DECADES * c))} is an outlier`));
      }
    }
    if (maps.truth) {
      const truth = maps.truth[i], off = truth && depth ? `, off by ${signed((depth - truth) * M_PER_STEP, 2, "m")}` : "";
      const wrong = off && maps.isWrong(depth, truth) ? ", an outlier by KITTI's rule" : "";
      rows.push(row("truth", truth ? `${metres(truth * M_PER_STEP)}${off}${wrong}` : "none"));
    }
    for (const [method, map] of Object.entries(maps.others)) {
      const name = methodName(method);
      rows.push(row(name, map[i] ? metres(map[i] * M_PER_STEP) : "no depth"));
    }
    if (maps.reason && REASONS[maps.reason[i]]) rows.push(row("left out here", REASONS[maps.reason[i]][0]));
    $("reading").tBodies[0].replaceChildren(...rows);
  }
  tellKept(confidence, ageMs) {
    const maps = this.maps, rows = maps.statistics(this.kept), head = ["", "pixels with a depth"];
    $("confidence-out").textContent = confidence.toFixed(2);
    $("age-out").textContent = ageMs === Infinity ? "any" : `${ageMs} ms`;
    if (maps.confidence) head.push("expected outliers");
    if (maps.truth) head.push("outliers (truth)", "mean error");
    const cells = (r) => {
      const all = [percent(r.density)];
      if (maps.confidence) all.push(percent(r.expected));
      if (maps.truth) all.push(percent(r.outliers), metres(r.maeM, 3));
      return all.map(numberCell);
    };
    $("kept").replaceChildren(
      element("tr", {}, ...head.map((text, i) => element("th", { scope: "col", class: i ? "number" : "" }, text))),
      ...rows.map((r) => row(r.product, ...cells(r))),
    );
    const curve = heldOutAt(maps.name, confidence);
    const held = isNumber(curve) ? `With the key sweep held out, ${percent(curve)} of the measured pixels this certain are outliers.` : "";
    $("kept-note").textContent = rows.some((r) => r.isFew) ? `${FEW_PIXELS} ${held}` : held;
    const age = ageMs === Infinity ? "" : ` --max-age-ms ${ageMs}`;
    $("export-command").parentElement.hidden = !page.folder;
    $("export-command").textContent = page.folder ? `densify export ${page.folder} --to npy --min-confidence ${confidence}${age}` : "";
  }
}

// Of the curve in the metrics, at the step below.
function heldOutAt(camera, confidence) {
  const curve = page.methods[page.method]?.held_out?.[camera]?.curve;
  if (!Array.isArray(curve)) return null;
  const below = curve.filter((step) => step.min_confidence <= confidence + 1e-9);
  return below.length ? below[below.length - 1].outliers_measured : null;
}
