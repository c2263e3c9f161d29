// SPDX-License-Identifier: MIT
// Colour maps and their legends. Depth is red (near) to blue (far) by default, as in figure.png and
// the docs: turbo. Colour-blind people read it less well, so viridis and cividis are in the menu.

const palettes = Object.fromEntries(
  Object.entries(page.palettes).map(([name, text]) => [
    name,
    Uint8Array.from(atob(text), (c) => c.charCodeAt(0)),
  ]),
);

// Okabe and Ito's colours.
const DISTINCT = [
  [230, 159, 0], [86, 180, 233], [0, 158, 115], [240, 228, 66],
  [0, 114, 178], [213, 94, 0], [204, 121, 167], [200, 200, 200],
];
const REASONS = {
  3: ["occluded by another surface", [86, 180, 233]],
  5: ["the key sweep does not agree", [240, 228, 66]],
  6: ["too close to a depth discontinuity", [0, 158, 115]],
};
const EARLIER = [[255, 250, 240], [86, 180, 233], [0, 84, 150]];
const LATER = [[255, 250, 240], [230, 159, 0], [150, 60, 0]];

const rgbText = ([r, g, b]) => `rgb(${r},${g},${b})`;

function mixed(stops, at) {
  const place = Math.min(Math.max(at, 0), 1) * (stops.length - 1);
  const below = Math.min(Math.floor(place), stops.length - 2);
  return stops[below].map((v, i) => Math.round(v + (place - below) * (stops[below + 1][i] - v)));
}

// Before the key blue, after it orange, the darker the farther.
const timeColour = (seconds, most) => mixed(seconds < 0 ? EARLIER : LATER, Math.sqrt(Math.abs(seconds) / most));

// A scale from numbers to 256 colours.
class Scale {
  constructor({ low, high, palette, log = false, reverse = false, unit, ticks }) {
    Object.assign(this, { low, high, palette, log, reverse, unit, ticks });
  }
  level(value) {
    const [a, b, v] = this.log
      ? [Math.log(this.low), Math.log(this.high), Math.log(Math.max(value, 1e-9))]
      : [this.low, this.high, value];
    const share = Math.min(Math.max((v - a) / (b - a || 1), 0), 1);
    return Math.round(255 * (this.reverse ? 1 - share : share));
  }
  colour(value) {
    const at = 3 * this.level(value);
    return [...palettes[this.palette].subarray(at, at + 3)];
  }
  // What 0 to most, in such steps, look like: (most + 1) x RGB.
  table(most, step) {
    const table = new Uint8Array(3 * (most + 1));
    for (let i = 0; i <= most; i++) {
      const at = 3 * this.level(i * step);
      table.set(palettes[this.palette].subarray(at, at + 3), 3 * i);
    }
    return table;
  }
}

// legend: {title, scale} or {title, marks: [[text, rgb], ...]}
function drawLegend(canvas, legend) {
  canvas.hidden = !legend;
  if (!legend) return;
  const ratio = devicePixelRatio || 1;
  const width = canvas.clientWidth, height = 40;
  canvas.width = width * ratio;
  canvas.height = height * ratio;
  const c = canvas.getContext("2d");
  c.scale(ratio, ratio);
  c.font = "12px system-ui, sans-serif";
  c.fillStyle = cssColour("--text");
  c.textBaseline = "alphabetic";
  const said = legend.scale
    ? `${legend.scale.low} to ${legend.scale.high} ${legend.scale.unit}`
    : legend.marks.map(([text]) => text).join(", ");
  canvas.setAttribute("aria-label", `Legend, ${legend.title}: ${said}`);
  if (legend.marks) return drawMarks(c, legend, width);
  const scale = legend.scale, left = 20, right = width - 30;
  for (let x = left; x < right; x++) {
    const share = (x - left) / (right - left - 1);
    const value = scale.log
      ? scale.low * (scale.high / scale.low) ** share
      : scale.low + share * (scale.high - scale.low);
    c.fillStyle = rgbText(scale.colour(value));
    c.fillRect(x, 14, 1.5, 10);
  }
  c.fillStyle = cssColour("--text");
  c.fillText(legend.title, left, 10);
  c.textAlign = "center";
  for (const tick of scale.ticks) {
    const share = scale.log
      ? Math.log(tick / scale.low) / Math.log(scale.high / scale.low)
      : (tick - scale.low) / (scale.high - scale.low);
    const x = left + share * (right - left);
    c.fillRect(x - 0.5, 24, 1, 4);
    c.fillText(`${tick} ${scale.unit}`, x, 38);
  }
}

function drawMarks(c, legend, width) {
  c.fillText(legend.title, 8, 10);
  let x = 8, y = 24;
  for (const [text, rgb] of legend.marks) {
    const wide = 22 + c.measureText(text).width;
    if (x + wide > width && x > 8) [x, y] = [8, y + 14];
    c.fillStyle = rgbText(rgb);
    c.fillRect(x, y - 9, 10, 10);
    c.fillStyle = cssColour("--text");
    c.fillText(text, x + 14, y);
    x += wide;
  }
}
