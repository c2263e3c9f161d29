// SPDX-License-Identifier: MIT
// The page of many keys: filters, histograms that filter too, a sortable table with pictures.

const STATUS = { done: "done", aside: "put aside", failed: "failed" };
const SCORES = [
  { name: "density", text: "measured", write: (v) => percent(v, 1), camera: true },
  { name: "density_filled", text: "filled", write: (v) => percent(v, 1), camera: true },
  { name: "outliers", text: "wrong, held out", write: (v) => percent(v), camera: true },
  { name: "mae_m", text: "mean error", write: (v) => metres(v, 3), camera: true },
  { name: "ghost", text: "ghosts", write: (v) => percent(v) },
  { name: "num_moving", text: "moving points", write: whole },
  { name: "seconds", text: "seconds", write: (v) => known(v, (s) => s.toFixed(1)) },
];
const NUM_BARS = 24;

let table, sheetsOf = [];
const chosen = {}; // score -> [from, to] of the bar that filters

const camera = () => Math.max(0, page.cameras.indexOf($("camera").value));
const valueOf = (row, score) => (score.camera ? row[score.name][camera()] : row[score.name]) ?? null;
const link = (row, text) => (row.link ? element("a", { href: row.link, target: "_blank", rel: "noopener", title: row.is_page ? "its page" : "its depth map" }, text) : text);

function picture(row) {
  const box = element("span", { class: "picture" });
  if (row.picture === null || row.picture === undefined) return box;
  const { columns, per_sheet: perSheet, size_px: [width, height] } = page.pictures;
  const at = row.picture % perSheet;
  box.setAttribute("role", "img");
  box.setAttribute("aria-label", `depth of ${row.drive}, key ${row.key}`);
  const image = sheetsOf[Math.floor(row.picture / perSheet)];
  if (image) box.style.background = `url(${image}) -${width * (at % columns)}px -${height * Math.floor(at / columns)}px`;
  return link(row, box);
}

function columns() {
  const scores = SCORES.map((score) => ({ ...score, number: true, of: (row) => valueOf(row, score), cell: (row) => score.write(valueOf(row, score)) }));
  return [
    { name: "order", text: "order", of: (row) => row.at, cell: picture },
    { name: "drive", text: "recording", of: (row) => row.drive, cell: (row) => element("span", { title: row.drive }, row.drive) },
    { name: "key", text: "key", number: true, of: (row) => row.key, cell: (row) => link(row, String(row.key)) },
    { name: "sweeps", text: "sweeps", number: true, of: (row) => row.sweeps, cell: (row) => String(row.sweeps) },
    ...scores,
    { name: "reason", text: "status", of: (row) => `${row.status} ${row.reason}`, cell: (row) => element("span", { class: `status-${row.status in STATUS ? row.status : "failed"}`, title: row.reason }, [STATUS[row.status], row.reason].filter(Boolean).join(": ")) },
  ];
}

// leaveOut: the score whose bar does not filter, for its own histogram.
function listed(leaveOut = null) {
  const [status, drive, words] = [$("status").value, $("drive").value, $("search").value.toLowerCase().split(/\s+/).filter(Boolean)];
  const limits = SCORES.filter((s) => chosen[s.name] && s.name !== leaveOut).map((s) => [s, ...chosen[s.name]]);
  return page.rows.filter((row) => {
    if (status && row.status !== status) return false;
    if (drive && row.drive !== drive) return false;
    if (words.length) {
      const text = `${row.drive} ${row.key} ${row.reason}`.toLowerCase();
      if (!words.every((word) => text.includes(word))) return false;
    }
    return limits.every(([score, from, to]) => {
      const value = valueOf(row, score);
      return isNumber(value) && value >= from && value <= to;
    });
  });
}

function histogram(score) {
  const rows = listed(score.name).map((row) => valueOf(row, score)).filter(isNumber);
  const panel = element("div", { class: "panel" }, element("h3", {}, score.text));
  if (!rows.length) return null;
  const [width, height] = [360, 130], low = Math.min(...rows), high = Math.max(...rows);
  const step = (high - low) / NUM_BARS || 1, counts = new Array(NUM_BARS).fill(0);
  for (const v of rows) counts[Math.min(NUM_BARS - 1, Math.floor((v - low) / step))]++;
  const most = Math.max(...counts), mean = rows.reduce((a, b) => a + b, 0) / rows.length;
  const plot = svg("svg", { viewBox: `0 0 ${width} ${height}`, width: "100%", role: "group", "aria-label": `${score.text}: ${score.write(low)} to ${score.write(high)}, mean ${score.write(mean)}` });
  counts.forEach((count, i) => {
    const tall = count ? Math.max(2, (count / most) * (height - 22)) : 0, wide = width / NUM_BARS;
    const [from, to] = [low + i * step, i === NUM_BARS - 1 ? high : low + (i + 1) * step];
    const said = `${score.write(from)} to ${score.write(to)}: ${whole(count)} keys`;
    const isChosen = chosen[score.name] && Math.abs(chosen[score.name][0] - from) < step / 2;
    const bar = svg("rect", { class: isChosen ? "bar-part chosen" : "bar-part", x: i * wide + 1, y: height - 18 - tall, width: wide - 2, height: tall, role: "button", tabindex: count ? 0 : -1, "aria-label": said, "aria-pressed": String(!!isChosen) }, svg("title", {}, said));
    const choose = () => {
      if (isChosen) delete chosen[score.name];
      else chosen[score.name] = [from, to];
      refresh();
    };
    bar.addEventListener("click", choose);
    bar.addEventListener("keydown", (e) => { if (e.key === "Enter" || e.key === " ") { e.preventDefault(); choose(); } });
    plot.append(bar);
  });
  plot.append(svg("text", { x: 0, y: height - 4 }, score.write(low)), svg("text", { x: width, y: height - 4, "text-anchor": "end" }, score.write(high)),
    svg("text", { x: width / 2, y: height - 4, "text-anchor": "middle" }, `mean ${score.write(mean)}`));
  panel.append(plot);
  return panel;
}

function refresh() {
  const rows = listed();
  table.fill(rows);
  $("listed").textContent = `${whole(rows.length)} of ${whole(page.rows.length)} keys`;
  $("histograms").replaceChildren(...SCORES.map(histogram).filter(Boolean));
}

function facts() {
  const count = (status) => page.rows.filter((row) => row.status === status).length;
  const fact = (name, value, small = " ") => element("div", {}, element("dt", {}, name), element("dd", {}, value, element("small", {}, small)));
  const mean = (score) => {
    const values = page.rows.flatMap((row) => (score.camera ? row[score.name] : [row[score.name]])).filter(isNumber);
    return values.length ? values.reduce((a, b) => a + b, 0) / values.length : null;
  };
  const of = (name) => SCORES.find((score) => score.name === name);
  const seconds = page.rows.reduce((all, row) => all + (row.seconds || 0), 0);
  $("facts").replaceChildren(
    fact("keys done", whole(count("done")), page.num_left ? `${whole(page.num_left)} to be made` : " "),
    fact("put aside", whole(count("aside")), `${whole(count("failed"))} failed`),
    fact("recordings", whole(new Set(page.rows.map((row) => row.drive)).size), `${page.cameras.length} camera${page.cameras.length === 1 ? "" : "s"}`),
    fact("measured pixels", percent(mean(of("density")), 1), `${percent(mean(of("density_filled")), 1)} filled; means`),
    fact("wrong, key held out", percent(mean(of("outliers"))), `ghosts ${percent(mean(of("ghost")))}; means`),
    fact("hours of computing", (seconds / 3600).toFixed(1), `${(seconds / Math.max(1, page.rows.length)).toFixed(1)} s a key`),
  );
}

// Reasons alike but for their numbers count together.
function reasons() {
  const kinds = new Map();
  for (const row of page.rows) {
    if (row.status === "done") continue;
    const kind = `${STATUS[row.status] || "failed"}: ${(row.reason || "").replace(/\d[\d.,]*/g, "…")}`;
    kinds.set(kind, [...(kinds.get(kind) || []), row]);
  }
  $("aside").hidden = !kinds.size;
  const some = [...kinds].sort((a, b) => b[1].length - a[1].length).slice(0, 30);
  $("reasons").replaceChildren(
    element("tr", {}, ...["why", "keys", "for example"].map((t, i) => element("th", { scope: "col", class: i === 1 ? "number" : "" }, t))),
    ...some.map(([kind, rows]) => row(kind, numberCell(whole(rows.length)), `${rows[0].drive} ${rows[0].key}: ${rows[0].reason}`)),
  );
}

async function start() {
  themeButton(() => drawLegend($("legend"), depthLegend()));
  page.rows.forEach((row, at) => { row.at = at; });
  const depthLegend = () => ({ title: "depth in the pictures", scale: new Scale({ low: page.pictures.near_m, high: page.pictures.far_m, log: true, reverse: true, palette: "viridis", unit: "m", ticks: [3, 5, 10, 20, 40, 80] }) });
  await section("The summary", facts);
  await section("What was put aside", reasons);
  await section("The keys", async () => {
    fillSelect($("status"), [["", "all"], ...Object.entries(STATUS)], "");
    fillSelect($("drive"), [["", "all"], ...[...new Set(page.rows.map((row) => row.drive))].map((d) => [d, d])], "");
    fillSelect($("camera"), page.cameras.map((c) => [c, c]));
    sheetsOf = page.pictures.sheets.map((entry) => URL.createObjectURL(new Blob([bytesOf(entry.blob)], { type: entry.mime })));
    table = new Rows(columns());
    for (const id of ["status", "drive", "camera"]) $(id).addEventListener("change", refresh);
    $("search").addEventListener("input", refresh);
    refresh();
    drawLegend($("legend"), depthLegend());
  });
  const fill = (id, entries) => $(id).replaceChildren(...entries.map(([key, value]) => row(key, String(value ?? "–"))));
  fill("about", page.about);
  fill("config", page.config);
  $("footer").textContent = page.footer;
  document.documentElement.dataset.ready = "yes";
}

start();
