// SPDX-License-Identifier: MIT
// Scores and costs as tables.

const PARTS = ["all", "moving", "static"];
// A share of fewer pixels than page.least_pixels is no result: null, which is shown as a dash.
const shownScore = (scores, name) =>
  (scores?.[name === "coverage" ? "num_pixels" : "num_compared"] >= page.least_pixels ? scores[name] : null);
const FEW_PIXELS = `–: fewer than ${page.least_pixels} pixels to judge.`;
const SOURCES = [["depth", "Against the truth"], ["held_out", "Key sweep held out, against its own returns"]];

function scoreTables(camera) {
  const tables = [];
  let isFew = false;
  for (const [source, title] of SOURCES) {
    for (const product of ["measured", "filled"]) {
      const found = Object.entries(page.methods).filter(([, scores]) => scores?.[source]?.[camera]?.[product]);
      if (!found.length) continue;
      tables.push(scoreTable(`${title}: ${product}, ${camera}`, found, source, product, camera));
      const parts = found.flatMap(([, s]) => PARTS.map((part) => s[source][camera][product][part]));
      isFew ||= parts.some((s) => isNumber(s?.outliers) && shownScore(s, "outliers") === null);
    }
  }
  if (isFew) tables.push(element("p", { class: "small" }, FEW_PIXELS));
  const ghosts = Object.entries(page.methods).filter(([, s]) => isNumber(s?.ghosts?.all));
  if (ghosts.length) {
    const table = element("table", {}, caption("Ghosts: accumulated points at positions that the key sweep saw through"));
    table.append(headRow("", "ghosts", "of moving points", "of static points", "points", "on moving objects", "pixels measured", "filled"));
    for (const [name, s] of ghosts) {
      const density = s.density?.[camera] || {};
      table.append(methodRow(name, [percent(s.ghosts.all), percent(s.ghosts.moving), percent(s.ghosts.static), whole(s.num_points), whole(s.num_moving), percent(density.measured, 1), percent(density.filled, 1)]));
    }
    tables.push(element("div", { class: "scroll" }, table));
  }
  $("score-tables").replaceChildren(...(tables.length ? tables : [element("p", { class: "small" }, "There are no scores here.")]));
}

const caption = (text) => element("caption", {}, element("span", {}, text));
const headRow = (...texts) => element("tr", {}, ...texts.map((t, i) => element("th", { scope: "col", class: i ? "number" : "" }, t)));
function methodRow(name, cells) {
  const tr = row(methodName(name) === name ? name : `${methodName(name)} (${name})`, ...cells.map(numberCell));
  if (name === page.method) tr.className = "ours";
  return tr;
}

function scoreTable(title, found, source, product, camera) {
  const table = element("table", {}, caption(title));
  const parts = PARTS.filter((part) => found.some(([, s]) => isNumber(s[source][camera][product][part]?.outliers)));
  table.append(headRow("", ...parts.flatMap((p) => [`${p}: outliers`, "MAE", "RMSE", "coverage"])));
  for (const [name, scores] of found) {
    const cells = parts.flatMap((part) => {
      const s = scores[source][camera][product][part] || {};
      const [outliers, mae, rmse, coverage] = ["outliers", "mae_m", "rmse_m", "coverage"].map((n) => shownScore(s, n));
      return [percent(outliers), metres(mae, 3), metres(rmse, 2), percent(coverage, 1)];
    });
    table.append(methodRow(name, cells));
  }
  return element("div", { class: "scroll" }, table);
}

function costs() {
  const stages = page.about.stages;
  if (!Array.isArray(stages) || !stages.length) {
    $("costs").append(element("p", { class: "small" }, "This folder has no times of the stages."));
    return;
  }
  const most = Math.max(...stages.map((s) => s.seconds || 0), 1e-9);
  const table = element("table", {}, headRow("stage", "seconds", "", "peak memory at its end"));
  for (const stage of stages) {
    const bar = element("i");
    bar.style.width = `${(100 * (stage.seconds || 0)) / most}%`;
    table.append(row(String(stage.name), numberCell(known(stage.seconds, (v) => v.toFixed(2))),
      element("td", {}, element("div", { class: "track" }, bar)), numberCell(known(stage.peak_memory_mb, (v) => `${whole(v)} MB`))));
  }
  table.append(row("elapsed", numberCell(known(page.about.elapsed_s, (v) => v.toFixed(2))), "", ""));
  $("costs").append(
    element("div", { class: "scroll" }, table),
    element("p", { class: "small" }, "Wall seconds. Stages overlap: together they can be longer than the elapsed time."),
    element("p", { class: "small" }, "Memory: the peak of the process from its start to the end of the stage. Stages are listed by their first end. A stage that runs again later, such as read, has the peak at its last end, so the column can fall."),
  );
}
