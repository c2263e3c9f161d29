// SPDX-License-Identifier: MIT
// Unpack what densify/outputs/report_page.py packs: base64, deflate, bytes by significance,
// differences.

const page = JSON.parse(document.getElementById("page-data").textContent);

function blobText(name) {
  const element = document.getElementById(name);
  if (!element) throw new Error(`${name} is not in this page`);
  return element.textContent;
}

function bytesOf(name) {
  const text = atob(blobText(name));
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < bytes.length; i++) bytes[i] = text.charCodeAt(i);
  return bytes;
}

// An array as Python packed it: a typed array in its order, row by row.
async function unpack(entry) {
  if (typeof DecompressionStream === "undefined") {
    throw new Error("this browser is too old: it has no DecompressionStream (2023)");
  }
  const stream = new Blob([bytesOf(entry.blob)]).stream();
  const inflated = stream.pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(inflated).arrayBuffer());
  const count = entry.shape.reduce((product, n) => product * n, 1);
  if (planes.length !== count * entry.bytes) throw new Error(`${entry.blob} is damaged`);
  const values = new { 1: Uint8Array, 2: Uint16Array, 4: Uint32Array }[entry.bytes](count);
  values.set(planes.subarray(0, count));
  for (let plane = 1; plane < entry.bytes; plane++) {
    const start = plane * count;
    for (let i = 0; i < count; i++) values[i] += planes[start + i] * 2 ** (8 * plane);
  }
  if (entry.delta) {
    const width = entry.shape[entry.shape.length - 1];
    for (let i = 0; i < count; i++) if (i % width) values[i] += values[i - 1];
  }
  return values;
}

async function unpackImage(entry) {
  const image = new Image();
  image.src = `data:${entry.mime};base64,${blobText(entry.blob)}`;
  await image.decode();
  return image;
}
