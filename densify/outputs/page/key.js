// SPDX-License-Identifier: MIT
// The page of one key.

function facts() {
  const scores = page.methods[page.method] || {}, list = [];
  const fact = (name, value, small) => list.push(element("div", {}, element("dt", {}, name), element("dd", {}, value, element("small", {}, small || " "))));
  const camera = Object.keys(page.cameras)[0], entry = page.cameras[camera];
  if (entry) fact("pixels with a depth", percent(entry.density.filled, 1), `${percent(entry.density.measured, 1)} measured, ${camera}`);
  for (const [source, name] of [["depth", "outliers, against the truth"], ["held_out", "outliers, key held out"]]) {
    const wrong = (m) => shownScore(page.methods[m]?.[source]?.[camera]?.measured?.all, "outliers");
    if (isNumber(wrong(page.method))) fact(name, percent(wrong(page.method)), page.method !== "icp" && isNumber(wrong("icp")) ? `${percent(wrong("icp"))} with rigid accumulation` : "measured pixels");
  }
  if (isNumber(scores.ghosts?.all)) {
    const icp = page.methods.icp?.ghosts?.all;
    fact("ghosts", percent(scores.ghosts.all), isNumber(icp) && page.method !== "icp" ? `${percent(icp)} with rigid accumulation` : "of the accumulated points");
  }
  if (isNumber(scores.num_points)) fact("points", whole(scores.num_points), `${whole(scores.num_moving)} on moving objects`);
  const stages = Array.isArray(page.about.stages) ? page.about.stages : [];
  if (stages.length) {
    const peak = Math.max(...stages.map((s) => s.peak_memory_mb || 0));
    fact("seconds elapsed", known(page.about.elapsed_s, (v) => v.toFixed(1)), `${(peak / 1000).toFixed(1)} GB at most`);
  }
  $("facts").replaceChildren(...list);
}

function warnings() {
  if (!page.warnings.length) $("warnings").append(element("p", { class: "small" }, "There are no warnings."));
  for (const warning of page.warnings) $("warnings").append(element("p", { class: "note" }, warning));
  $("footer").textContent = page.footer;
}

let imagePane, cloudPane; // also for who looks at the page from a console

async function start() {
  themeButton(() => { imagePane?.legends(); if (cloudPane?.heights) cloudPane.legend(); });
  $("subtitle").textContent = page.subtitle;
  for (const problem of page.missing) tell(problem);
  await section("The summary", facts);
  await section("Warnings", warnings);
  await section("The cost", costs);
  const names = Object.keys(page.cameras);
  const scored = names.length ? names : [...new Set(Object.values(page.methods).flatMap((s) => Object.keys(s?.density || {})))];
  const showScores = (camera) => section("The scores", () => scoreTables(camera));
  if (scored.length) await showScores(scored[0]);
  $("image").hidden = !names.length;
  if (names.length) {
    await section("The image", async () => {
      imagePane = new ImagePane(names);
      $("camera").addEventListener("change", () => showScores($("camera").value));
      await imagePane.open(names[0]);
    });
  }
  $("cloud").hidden = !page.cloud;
  if (page.cloud) {
    await section("The cloud", async () => {
      cloudPane = new CloudPane();
      await cloudPane.open();
    });
  }
  document.documentElement.dataset.ready = "yes";
}

start();
