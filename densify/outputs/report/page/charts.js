// SPDX-License-Identifier: MIT
// Scores as tables, and as curves where they are.

const PARTS = ["all", "moving", "static"];
const SOURCES = [["depth", "Against the truth"], ["held_out", "Key sweep held out, against its own returns"]];

function scoreTables(camera) {
  const tables = [];
  for (const [source, title] of SOURCES) {
    for (const product of ["measured", "filled"]) {
      const found = Object.entries(page.methods).filter(([, scores]) => scores?.[source]?.[camera]?.[product]);
      if (found.length) tables.push(scoreTable(`${title}: ${product}, ${camera}`, found, source, product, camera));
    }
  }
  const ghosts = Object.entries(page.methods).filter(([, s]) => isNumber(s?.ghosts?.all));
  if (ghosts.length) {
    const table = element("table", {}, element("caption", {}, "Accumulated points where the key sweep saw through (ghosts), and points"));
    table.append(headRow("", "ghosts", "of what moves", "of what stands", "points", "on moving objects", "pixels measured", "filled"));
    for (const [name, s] of ghosts) {
      const density = s.density?.[camera] || {};
      table.append(methodRow(name, [percent(s.ghosts.all), percent(s.ghosts.moving), percent(s.ghosts.static), whole(s.num_points), whole(s.num_moving), percent(density.measured, 1), percent(density.filled, 1)]));
    }
    tables.push(element("div", { class: "scroll" }, table));
  }
  $("score-tables").replaceChildren(...(tables.length ? tables : [element("p", { class: "small" }, "There are no scores here.")]));
}

const headRow = (...texts) => element("tr", {}, ...texts.map((t, i) => element("th", { scope: "col", class: i ? "number" : "" }, t)));
function methodRow(name, cells) {
  const tr = row(methodName(name) === name ? name : `${methodName(name)} (${name})`, ...cells.map(numberCell));
  if (name === page.method) tr.className = "ours";
  return tr;
}

function scoreTable(title, found, source, product, camera) {
  const table = element("table", {}, element("caption", {}, title));
  const parts = PARTS.filter((part) => found.some(([, s]) => isNumber(s[source][camera][product][part]?.outliers)));
  table.append(headRow("", ...parts.flatMap((p) => [`${p}: wrong`, "MAE", "RMSE", "coverage"])));
  for (const [name, scores] of found) {
    const cells = parts.flatMap((part) => {
      const s = scores[source][camera][product][part] || {};
      return [percent(s.outliers), metres(s.mae_m, 3), metres(s.rmse_m, 2), percent(s.coverage, 1)];
    });
    table.append(methodRow(name, cells));
  }
  return element("div", { class: "scroll" }, table);
}

// curves: [{name, points: [[x, y], ...], rgb, dashed}]. Shares, y on a logarithmic scale.
function chart({ title, note, xName, yName, curves, xLog = false, diagonal = false }) {
  const [width, height, left, bottom, top, right] = [520, 300, 56, 36, 10, 24];
  const drawn = curves.map((c) => ({ ...c, points: c.points.filter(([x, y]) => isNumber(x) && isNumber(y) && y > 0 && (!xLog || x > 0)) })).filter((c) => c.points.length);
  const panel = element("div", { class: "panel" }, element("h3", {}, title));
  if (!drawn.length) return null;
  const all = drawn.flatMap((c) => c.points), ys = all.map((p) => p[1]), xs = all.map((p) => p[0]);
  const decade = (v, round) => 10 ** round(Math.log10(v));
  let [y0, y1] = [decade(Math.min(...ys), Math.floor), decade(Math.max(...ys), Math.ceil)];
  let [x0, x1] = xLog ? [decade(Math.min(...xs), Math.floor), decade(Math.max(...xs), Math.ceil)] : [0, Math.max(0.1, Math.ceil(10 * Math.max(...xs)) / 10)];
  if (y0 === y1) y1 *= 10;
  if (x0 === x1) x1 *= 10;
  const along = (v, a, b, log) => (log ? Math.log(v / a) / Math.log(b / a) : (v - a) / (b - a));
  const px = (x) => left + along(x, x0, x1, xLog) * (width - left - right);
  const py = (y) => height - bottom - along(y, y0, y1, true) * (height - bottom - top);
  const inside = ([x, y]) => `${px(Math.min(Math.max(x, x0), x1)).toFixed(1)},${py(Math.min(Math.max(y, y0), y1)).toFixed(1)}`;
  const plot = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "img", width: "100%" });
  plot.append(svg("title", {}, `${title}: ${yName} over ${xName}; ${drawn.map((c) => c.name).join(", ")}`));
  const text = (x, y, anchor, value) => plot.append(svg("text", { x, y, "text-anchor": anchor }, value));
  const short = (v) => `${Number((100 * v).toPrecision(2))} %`;
  for (let y = y0; y <= y1 * 1.001; y *= 10) {
    plot.append(svg("line", { class: "axis", x1: left, x2: width - right, y1: py(y), y2: py(y) }));
    text(left - 6, py(y) + 4, "end", short(y));
  }
  const xTicks = xLog ? Array.from({ length: Math.round(Math.log10(x1 / x0)) + 1 }, (_, i) => x0 * 10 ** i) : [0, 1, 2, 3, 4].map((i) => x0 + (i * (x1 - x0)) / 4);
  for (const x of xTicks) {
    plot.append(svg("line", { class: "axis", x1: px(x), x2: px(x), y1: top, y2: height - bottom }));
    text(px(x), height - bottom + 14, "middle", short(x));
  }
  text((left + width) / 2, height - 4, "middle", `${xName}; up: ${yName}`);
  if (diagonal) {
    const [a, b] = [Math.max(x0, y0), Math.min(x1, y1)];
    plot.append(svg("line", { class: "axis", x1: px(a), y1: py(a), x2: px(b), y2: py(b), "stroke-dasharray": "3 3" }));
  }
  for (const c of drawn) {
    const stroke = rgbText(c.rgb);
    plot.append(svg("polyline", { points: c.points.map(inside).join(" "), fill: "none", stroke, "stroke-width": 2, "stroke-dasharray": c.dashed ? "6 4" : "none" }));
    for (const p of c.points) {
      const [cx, cy] = inside(p).split(",");
      plot.append(svg("circle", { cx, cy, r: 2.4, fill: stroke }));
    }
  }
  panel.append(plot);
  const keys = drawn.map((c) => {
    const swatch = element("i", { class: "swatch" });
    swatch.style.background = rgbText(c.rgb);
    return element("span", {}, swatch, `${c.name}${c.dashed ? " (dashed)" : ""}  `);
  });
  panel.append(element("p", { class: "small" }, ...keys), element("p", { class: "small" }, note));
  return panel;
}

const METHOD_COLOURS = { none: DISTINCT[7], icp: DISTINCT[5], "icp-far": DISTINCT[6], paper: DISTINCT[0], flow: DISTINCT[1], "icp-visible": DISTINCT[2], "flow-plain": DISTINCT[3] };

function curveCharts(camera) {
  const panels = [];
  const curves = [];
  for (const [name, scores] of Object.entries(page.methods)) {
    const curve = scores?.held_out?.[camera]?.curve;
    if (!Array.isArray(curve)) continue;
    for (const product of ["measured", "filled"]) {
      curves.push({ name: `${methodName(name)}, ${product}`, rgb: METHOD_COLOURS[name] || DISTINCT[4], dashed: product === "filled",
        points: curve.map((s) => [s[`density_${product}`], s[`outliers_${product}`]]) });
    }
  }
  panels.push(chart({ title: `Error over density, ${camera}`, xName: "pixels that keep a depth", yName: "wrong, key held out", curves,
    note: "From right to left the least certain pixels are left out, in steps of 0.05 of confidence." }));
  const reliable = [];
  for (const [where, name, rgb] of [["reliability", "against the truth", DISTINCT[1]], ["held_out", "key held out", DISTINCT[0]]]) {
    const scores = page.methods[page.method]?.[where]?.[camera], steps = where === "held_out" ? scores?.reliability : scores;
    if (Array.isArray(steps)) reliable.push({ name, rgb, points: steps.map((s) => [s.expected, s.outliers]) });
  }
  panels.push(chart({ title: `Does confidence keep its promise? ${camera}`, xName: "wrong as confidence expects", yName: "found wrong", curves: reliable, xLog: true, diagonal: true,
    note: "On the dashed line as many pixels are wrong as confidence says; above it more." }));
  $("charts").replaceChildren(...panels.filter(Boolean));
}

function costs() {
  const stages = page.about.stages;
  if (!Array.isArray(stages) || !stages.length) {
    $("costs").append(element("p", { class: "small" }, "This folder does not say what the stages took."));
    return;
  }
  const most = Math.max(...stages.map((s) => s.seconds || 0), 1e-9);
  const table = element("table", {}, headRow("stage", "seconds", "", "peak memory so far"));
  for (const stage of stages) {
    const bar = element("i");
    bar.style.width = `${(100 * (stage.seconds || 0)) / most}%`;
    table.append(row(String(stage.name), numberCell(known(stage.seconds, (v) => v.toFixed(2))),
      element("td", {}, element("div", { class: "track" }, bar)), numberCell(known(stage.peak_memory_mb, (v) => `${whole(v)} MB`))));
  }
  const total = stages.reduce((all, s) => all + (s.seconds || 0), 0);
  table.append(row("together", numberCell(total.toFixed(2)), "", ""));
  $("costs").append(table, element("p", { class: "small" }, "Wall seconds; stages of several methods run side by side, so they can add up to more than the run took."));
}
