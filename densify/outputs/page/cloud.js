// SPDX-License-Identifier: MIT
// The cloud in 3-D: colours, from rigid accumulation to scene flow, sweep by sweep, movers, points of view.

const NEAR_M = 0.3, FAR_M = 900, FOV = 0.9;
const COLOURINGS = [["0", "camera"], ["1", "height"], ["2", "source sweep"], ["3", "moving object"], ["4", "confidence"], ["5", "distance moved"]];
const SLOW_MS = 40, PAUSE_MS = 1500, LEAST_SHARE = 0.02;

// Buffers of the points in an order of chance, so that the first few show everything thinly.
async function cloudBuffers(cloud) {
  const count = cloud.num_points;
  const columns = async (entries) => Promise.all(entries.map(unpack));
  const [places, rgb] = [await columns(cloud.places), await columns(cloud.rgb)];
  const [sweep, mover, confidence] = await columns([cloud.sweep, cloud.mover, cloud.confidence]);
  const displaced = cloud.displaced ? await columns(cloud.displaced) : [];
  const order = new Uint32Array(count).map((_, i) => i);
  let seed = 1;
  for (let i = count - 1; i > 0; i--) {
    seed = (Math.imul(seed, 1664525) + 1013904223) >>> 0;
    const j = seed % (i + 1), kept = order[i];
    order[i] = order[j];
    order[j] = kept;
  }
  const out = { places: new Uint16Array(4 * count), shifts: new Int16Array(4 * count), colours: new Uint8Array(4 * count) };
  const toByte = 255 / 63, certain = 255 / cloud.confidence_steps;
  for (let to = 0; to < count; to++) {
    const i = order[to], at = 4 * to;
    for (let k = 0; k < 3; k++) {
      out.places[at + k] = places[k][i];
      out.colours[at + k] = rgb[k][i] * toByte;
      if (displaced.length && i < displaced[k].length) out.shifts[at + k] = displaced[k][i] - 32768;
    }
    out.places[at + 3] = sweep[i];
    out.shifts[at + 3] = mover[i];
    out.colours[at + 3] = confidence[i] * certain;
  }
  return out;
}

class CloudPane {
  async open() {
    const cloud = page.cloud;
    this.painter = new Painter($("space"));
    this.window = page.sweeps.map((s, i) => ({ ...s, index: i })).filter((s) => !s.far);
    const buffers = await cloudBuffers(cloud);
    this.painter.setPoints(buffers);
    this.measureHeights(buffers.places);
    this.textures();
    this.canMorph = !!cloud.displaced && cloud.num_moving > 0;
    this.state = { yaw: Math.PI, pitch: 0.42, distance: 34, target: [9, 0, 0], fov: FOV };
    this.share = 1;
    this.sweep = null;
    this.controls();
    this.lines();
    this.moverTable();
    const shown = cloud.num_points < cloud.num_all
      ? `${whole(cloud.num_points)} of ${whole(cloud.num_all)} points: all moving ones, and static ones that are apart in the image.`
      : `All ${whole(cloud.num_all)} points.`;
    const icp = this.canMorph ? " “Rigid accumulation” shows the same points without scene flow." : "";
    $("cloud-note").textContent = shown + icp + " Drag turns, right button or shift moves, wheel comes nearer. Gray: observed by no camera.";
    new ResizeObserver(() => this.soon()).observe($("space"));
    this.legend();
    this.soon();
  }
  measureHeights(places) {
    const { low_m: low, step_m: step } = page.cloud, z = [];
    for (let i = 2; i < places.length; i += 4 * 101) z.push(low[2] + step * places[i]);
    z.sort((a, b) => a - b);
    const at = (share) => z[Math.floor(share * (z.length - 1))] || 0;
    const floor = Math.floor(at(0.02));
    this.heights = [floor, Math.max(floor + 4, Math.ceil(at(0.96)))];
  }
  textures() {
    const wide = (colours) => {
      const rgba = new Uint8Array(4 * colours.length);
      colours.forEach((c, i) => rgba.set([...c.slice(0, 3), c[3] ?? 255], 4 * i));
      return rgba;
    };
    this.mostS = Math.max(...this.window.map((s) => Math.abs(s.since_key_s) || 0), 0.1);
    const sweeps = page.sweeps.map((s) => [...timeColour(s.since_key_s || 0, this.mostS), s.far ? 0 : 255]);
    this.painter.texture(1, Math.max(sweeps.length, 1), 1, wide(sweeps.length ? sweeps : [[200, 200, 200]]));
    const movers = [[90, 90, 90], [200, 200, 200], ...page.movers.map((_, i) => DISTINCT[i % DISTINCT.length])];
    this.painter.texture(2, movers.length, 1, wide(movers));
    const two = new Uint8Array(4 * 512);
    ["viridis", "cividis"].forEach((name, r) => {
      for (let i = 0; i < 256; i++) two.set([...palettes[name].subarray(3 * i, 3 * i + 3), 255], 4 * (256 * r + i));
    });
    this.painter.texture(3, 256, 2, two);
    this.mostMoved = Math.max(1, ...page.movers.flatMap((m) => (m.path || []).map((p) => norm(sum(p.position_m, m.centre_m, -1)))));
  }
  controls() {
    const redraw = (id, kind = "change") => $(id).addEventListener(kind, () => { this.legend(); this.soon(); });
    const choices = COLOURINGS.filter(([n]) => (n !== "3" || page.cloud.num_moving) && (n !== "5" || this.canMorph));
    fillSelect($("colouring"), choices, "0");
    for (const id of ["colouring", "only-moving", "show-far", "show-cameras", "show-paths"]) redraw(id);
    for (const id of ["show-cameras", "show-paths"]) $(id).addEventListener("change", () => this.lines());
    for (const id of ["morph", "point-size"]) redraw(id, "input");
    $("morph").addEventListener("input", () => this.lines());
    for (const id of ["morph", "morph-play"]) $(id).disabled = !this.canMorph;
    fillSelect($("sweeps-shown"), [["all", "all"], ["one", "one"], ["until", "up to one"]], "all");
    $("sweep").max = Math.max(this.window.length - 1, 0);
    $("sweep").value = Math.max(this.window.findIndex((s) => s.frame === page.key), 0);
    $("sweep").addEventListener("input", () => { if ($("sweeps-shown").value === "all") $("sweeps-shown").value = "one"; this.tellSweep(); });
    $("sweeps-shown").addEventListener("change", () => this.tellSweep());
    $("morph-play").addEventListener("click", () => this.playMorph());
    $("sweep-play").addEventListener("click", () => this.playSweeps());
    $("only-moving").disabled = !page.cloud.num_moving;
    this.presets();
    this.pointer();
    this.tellSweep();
  }
  presets() {
    const go = (name, state) => element("button", { type: "button", onclick: () => this.look(state) }, name);
    const buttons = [
      go("behind", { yaw: Math.PI, pitch: 0.42, distance: 34, target: [9, 0, 0], fov: FOV }),
      go("above", { yaw: Math.PI, pitch: 1.55, distance: 60, target: [8, 0, 0], fov: FOV }),
      go("side", { yaw: -Math.PI / 2, pitch: 0.25, distance: 40, target: [8, 0, 0], fov: FOV }),
    ];
    for (const [name, view] of Object.entries(page.views)) {
      try {
        const { forward, origin } = inversePose(view.T_cam_key);
        const fov = 2 * Math.atan(view.height_px / 2 / view.K[1][1]);
        const state = {
          yaw: Math.atan2(-forward[1], -forward[0]), pitch: Math.asin(-unit(forward)[2]),
          distance: 8, target: sum(origin, unit(forward), 8), fov: Math.min(Math.max(fov, 0.35), 1.6), through: true,
        };
        if ([state.yaw, state.pitch, state.fov, ...state.target].every(isNumber)) buttons.push(go(`as ${name}`, state));
      } catch (_) { /* a view without a pose has no button */ }
    }
    $("views").replaceChildren(...buttons);
  }
  look(state) {
    Object.assign(this.state, { through: false }, state);
    this.lines();
  }
  moved() {
    if (this.state.through) this.look({});
    this.soon();
  }
  pointer() {
    const canvas = $("space"), held = new Map();
    let spread = 0;
    canvas.addEventListener("contextmenu", (e) => e.preventDefault());
    canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); held.set(e.pointerId, e); spread = 0; });
    const release = (e) => { held.delete(e.pointerId); spread = 0; };
    canvas.addEventListener("pointerup", release);
    canvas.addEventListener("pointercancel", release);
    canvas.addEventListener("pointermove", (e) => {
      const before = held.get(e.pointerId);
      if (!before) return;
      held.set(e.pointerId, e);
      const dx = e.clientX - before.clientX, dy = e.clientY - before.clientY;
      if (held.size === 2) {
        const [a, b] = [...held.values()], now = Math.hypot(a.clientX - b.clientX, a.clientY - b.clientY);
        if (spread) this.zoom(spread / now);
        spread = now;
        this.pan(dx / 2, dy / 2);
      } else if (e.buttons & 2 || e.shiftKey) this.pan(dx, dy);
      else this.orbit(-0.005 * dx, 0.005 * dy);
    });
    canvas.addEventListener("wheel", (e) => { e.preventDefault(); this.zoom(Math.exp(0.0012 * e.deltaY)); }, { passive: false });
    canvas.addEventListener("keydown", (e) => {
      const action = {
        ArrowLeft: () => this.orbit(0.06, 0), ArrowRight: () => this.orbit(-0.06, 0),
        ArrowUp: () => this.orbit(0, 0.05), ArrowDown: () => this.orbit(0, -0.05),
        "+": () => this.zoom(0.9), "=": () => this.zoom(0.9), "-": () => this.zoom(1.1),
        w: () => this.pan(0, 25), s: () => this.pan(0, -25), a: () => this.pan(25, 0), d: () => this.pan(-25, 0),
      }[e.key];
      if (!action || e.ctrlKey || e.metaKey) return;
      e.preventDefault();
      action();
    });
  }
  orbit(yaw, pitch) {
    const s = this.state;
    s.yaw += yaw;
    s.pitch = Math.min(Math.max(s.pitch + pitch, -1.2), 1.555);
    this.moved();
  }
  zoom(by) {
    this.state.distance = Math.min(Math.max(this.state.distance * by, 1), 400);
    this.moved();
  }
  pan(dx, dy) {
    const s = this.state, scale = (s.distance * Math.tan(s.fov / 2) * 2) / $("space").clientHeight;
    const ahead = [-Math.cos(s.yaw), -Math.sin(s.yaw), 0], left = cross([0, 0, 1], ahead);
    s.target = sum(sum(s.target, left, dx * scale), ahead, (dy * scale) / Math.max(Math.sin(Math.abs(s.pitch)), 0.35));
    this.moved();
  }
  tellSweep() {
    const sweep = this.window[Number($("sweep").value)], mode = $("sweeps-shown").value;
    $("sweep-out").textContent = mode === "all" || !sweep ? "" : `sweep ${sweep.frame}, ${signed(sweep.since_key_s, 1, "s")}`;
    this.lines();
    this.soon();
  }
  range() {
    const mode = $("sweeps-shown").value, sweep = this.window[Number($("sweep").value)];
    if (mode === "all" || !sweep) return [0, 65535];
    return [mode === "one" ? sweep.index : 0, sweep.index];
  }
  play(button, step) {
    if (this.playing) {
      this.playing.button.setAttribute("aria-pressed", "false");
      const same = this.playing.button === button;
      this.playing = null;
      if (same) return;
    }
    const mine = { button };
    this.playing = mine;
    button.setAttribute("aria-pressed", "true");
    const start = performance.now();
    const next = (now) => {
      if (this.playing !== mine) return;
      if (step((now - start) / 1000) === false) {
        this.playing = null;
        button.setAttribute("aria-pressed", "false");
      } else requestAnimationFrame(next);
    };
    requestAnimationFrame(next);
  }
  playMorph() {
    this.play($("morph-play"), (s) => {
      const t = Math.min(Math.max((s - 0.5) / 2, 0), 1);
      $("morph").value = t * t * (3 - 2 * t);
      this.lines();
      this.soon();
      return s < 2.6;
    });
  }
  playSweeps() {
    if ($("sweeps-shown").value === "all") $("sweeps-shown").value = "one";
    let last = -1;
    this.play($("sweep-play"), (s) => {
      const now = Math.floor(s * 4);
      if (now !== last) {
        last = now;
        $("sweep").value = now % this.window.length;
        this.tellSweep();
      }
      return this.window.length > 1;
    });
  }
  lines() {
    const segments = [], labels = [];
    const strip = (points, rgb) => points.slice(1).forEach((p, i) => segments.push([points[i], p, rgb]));
    if ($("show-cameras").checked && !this.state.through) {
      for (const view of Object.values(page.views)) segments.push(...frustum(view));
      const way = this.window.filter((s) => s.T_key_lidar).map((s) => s.T_key_lidar.slice(0, 3).map((r) => r[3]));
      strip(way, [255, 255, 255]);
    }
    if ($("show-paths").checked) {
      page.movers.forEach((mover, i) => {
        const rgb = DISTINCT[i % DISTINCT.length], path = (mover.path || []).map((p) => p.position_m);
        strip(path, rgb);
        for (const p of path) segments.push([sum(p, [0, 0, 0.25], -1), sum(p, [0, 0, 0.25]), rgb]);
        const speed = norm(mover.velocity_m_s);
        if (speed > 0.3) segments.push(...arrow(sum(mover.centre_m, [0, 0, 1.2]), mover.velocity_m_s, rgb));
        if (i < 12) labels.push({ at: sum(mover.centre_m, [0, 0, 1.5]), text: `${(3.6 * speed).toFixed(0)} km/h` });
      });
    }
    this.painter.setLines(segments);
    this.labels = labels.map((l) => ({ at: l.at, span: element("span", {}, l.text) }));
    $("space-labels").replaceChildren(...this.labels.map((l) => l.span));
    this.soon();
  }
  moverTable() {
    $("movers-panel").hidden = !page.movers.length;
    const head = ["object", "points", "speed", "place ahead, left", "length, width, height", ""];
    const rows = page.movers.map((m, i) => {
      const name = element("th", { scope: "row" }, element("i", { class: `swatch mover-${i % DISTINCT.length}` }), String(m.instance));
      name.firstChild.style.background = rgbText(DISTINCT[i % DISTINCT.length]);
      const speed = norm(m.velocity_m_s);
      const look = element("button", { type: "button", "aria-label": `Look at object ${m.instance}`,
        onclick: () => this.look({ target: m.centre_m, distance: 12, pitch: 0.45, fov: FOV }) }, "look");
      return element("tr", {}, name, numberCell(whole(m.num_points)),
        numberCell(`${speed.toFixed(1)} m/s, ${(3.6 * speed).toFixed(0)} km/h`),
        numberCell(m.centre_m.slice(0, 2).map((v) => v.toFixed(1)).join(", ") + " m"),
        numberCell(m.size_m.map((v) => v.toFixed(1)).join(" × ") + " m"), element("td", {}, look));
    });
    $("movers").replaceChildren(element("tr", {}, ...head.map((t, i) => element("th", { scope: "col", class: i && i < 5 ? "number" : "" }, t))), ...rows);
  }
  legend() {
    const kind = $("colouring").value, ticks = (high, n = 4) => Array.from({ length: n + 1 }, (_, i) => Number(((i * high) / n).toFixed(1)));
    const [low, high] = this.heights;
    const legend = {
      1: { title: "height over the lidar", scale: new Scale({ low, high, palette: "viridis", unit: "m", ticks: [low, 0, Math.round(high / 2), high].filter((t, i, all) => all.indexOf(t) === i) }) },
      2: { title: "sweep that measured the point; lighter is nearer to the key", marks: timeMarks(this.mostS) },
      3: { title: "moving objects; gray stands", marks: page.movers.slice(0, 16).map((m, i) => [String(m.instance), DISTINCT[i % DISTINCT.length]]) },
      4: { title: "confidence of the pixels that confirm the point", scale: confidenceScale() },
      5: { title: "moved beyond registration; gray is not moved", scale: new Scale({ low: 0, high: Number(this.mostMoved.toFixed(1)), palette: "viridis", unit: "m", ticks: ticks(this.mostMoved) }) },
    }[kind];
    drawLegend($("legend-cloud"), legend);
  }
  // A frame; a while after the last one that was asked for comes one with all points.
  soon(whole = false) {
    this.whole = whole;
    clearTimeout(this.settle);
    if (!whole) this.settle = setTimeout(() => this.soon(true), 300);
    if (this.waiting) return;
    this.waiting = true;
    const next = (now) => {
      if (this.painter.isBusy()) return requestAnimationFrame(next);
      this.waiting = false;
      this.draw(now);
    };
    requestAnimationFrame(next);
  }
  // While frames follow each other too slowly, fewer points are drawn; the last one has all.
  pace(now) {
    const since = now - (this.before || 0);
    this.before = now;
    if (since < PAUSE_MS) {
      this.frameMs = this.frameMs ? 0.8 * this.frameMs + 0.2 * since : since;
      if (since > SLOW_MS) this.share = Math.max(LEAST_SHARE, this.share * Math.max(SLOW_MS / since, 0.3));
      else if (this.frameMs < SLOW_MS / 2) this.share = Math.min(1, this.share * 1.1);
    } else this.frameMs = null;
  }
  draw(now) {
    const share = this.whole ? 1 : this.share;
    if (!this.whole) this.pace(now);
    this.painter.resize();
    const s = this.state, canvas = this.painter.canvas, cloud = page.cloud;
    const eye = sum(s.target, [Math.cos(s.pitch) * Math.cos(s.yaw), Math.cos(s.pitch) * Math.sin(s.yaw), Math.sin(s.pitch)], s.distance);
    const projection = perspective(s.fov, canvas.width / canvas.height, NEAR_M, FAR_M);
    const viewProjection = multiply(projection, lookAt(eye, s.target, [0, 0, 1]));
    const size = Number($("point-size").value), perMetre = canvas.height / 2 / Math.tan(s.fov / 2);
    this.painter.draw(viewProjection, {
      low: cloud.low_m, placeStep: cloud.step_m, shiftStep: cloud.displaced_step_m || 0,
      registered: 1 - Number($("morph").value), pointScale: size * perMetre, leastSize: 1.5 * size * Math.min(devicePixelRatio || 1, 2),
      colouring: Number($("colouring").value), heights: this.heights, mostMoved: this.mostMoved, sweeps: this.range(),
      onlyMoving: $("only-moving").checked, withFar: $("show-far").checked && $("sweeps-shown").value === "all",
    }, { share, nearFar: [NEAR_M, FAR_M], background: [0.02, 0.028, 0.04], withLines: true });
    this.placeLabels(viewProjection);
    const fps = this.frameMs && share < 1.001 && this.before === now ? `${(1000 / this.frameMs).toFixed(0)} frames a second` : "";
    $("space-note").textContent = [fps, share < 1 ? `while it moves, ${percent(share, 0)} of the points` : ""].filter(Boolean).join("; ");
  }
  placeLabels(viewProjection) {
    const { clientWidth: width, clientHeight: height } = $("space");
    for (const { at, span } of this.labels || []) {
      const [x, y, , w] = project(viewProjection, at);
      span.hidden = w < 1 || Math.abs(x) > w || Math.abs(y) > w || w > 90;
      span.style.transform = `translate(${((x / w + 1) / 2) * width}px, ${((1 - y / w) / 2) * height}px) translate(-50%, -100%)`;
    }
  }
}

function frustum(view) {
  try {
    const { right, down, forward, origin } = inversePose(view.T_cam_key), depth = 1.2, rgb = [255, 255, 255];
    const [[fx, , cx], [, fy, cy]] = view.K;
    const corner = (u, v) => sum(sum(sum(origin, forward, depth), right, (depth * (u - cx)) / fx), down, (depth * (v - cy)) / fy);
    const corners = [corner(0, 0), corner(view.width_px, 0), corner(view.width_px, view.height_px), corner(0, view.height_px)];
    return corners.flatMap((c, i) => [[origin, c, rgb], [c, corners[(i + 1) % 4], rgb]]);
  } catch (_) {
    return [];
  }
}

// Half a second of the way ahead.
function arrow(from, velocity, rgb) {
  const to = sum(from, velocity, 0.5), along = unit(velocity), across = unit(cross(along, [0, 0, 1]));
  const barb = (side) => sum(sum(to, along, -0.5), across, 0.25 * side);
  return [[from, to, rgb], [to, barb(1), rgb], [to, barb(-1), rgb]];
}
