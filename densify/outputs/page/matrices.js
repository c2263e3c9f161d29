// SPDX-License-Identifier: MIT
// 4 x 4 matrices by columns, as WebGL wants them, and vectors of three.

const sum = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const norm = (a) => Math.hypot(...a);
const unit = (a) => { const n = norm(a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };

function perspective(fovY, aspect, near, far) {
  const f = 1 / Math.tan(fovY / 2), d = near - far;
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) / d, -1, 0, 0, (2 * far * near) / d, 0];
}

function lookAt(eye, target, up) {
  const back = unit(sum(eye, target, -1)), right = unit(cross(up, back)), above = cross(back, right);
  return [
    right[0], above[0], back[0], 0, right[1], above[1], back[1], 0, right[2], above[2], back[2], 0,
    -dot(right, eye), -dot(above, eye), -dot(back, eye), 1,
  ];
}

function multiply(a, b) {
  const out = new Array(16).fill(0);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) for (let k = 0; k < 4; k++) out[4 * c + r] += a[4 * k + r] * b[4 * c + k];
  return out;
}

// [x, y, z, w] in clip space.
function project(m, p) {
  return [0, 1, 2, 3].map((r) => m[r] * p[0] + m[4 + r] * p[1] + m[8 + r] * p[2] + m[12 + r]);
}

// The inverse of a pose [[...], ...] by rows: its rotation's columns and where its origin is.
function inversePose(T) {
  const axis = (r) => [T[r][0], T[r][1], T[r][2]];
  const t = [T[0][3], T[1][3], T[2][3]];
  const origin = [0, 1, 2].map((k) => -(T[0][k] * t[0] + T[1][k] * t[1] + T[2][k] * t[2]));
  return { right: axis(0), down: axis(1), forward: axis(2), origin };
}
