// SPDX-License-Identifier: MIT
// Small helpers. Whatever comes from files becomes text, never markup.

const $ = (id) => document.getElementById(id);

function element(name, attributes = {}, ...children) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) {
    if (key === "class") made.className = value;
    else if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else made.setAttribute(key, value);
  }
  made.append(...children);
  return made;
}

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);
const known = (value, write) => (isNumber(value) ? write(value) : "–");
const percent = (value, digits = 2) => known(value, (v) => `${(100 * v).toFixed(digits)} %`);
const metres = (value, digits = 2) => known(value, (v) => `${v.toFixed(digits)} m`);
const whole = (value) => known(value, (v) => Math.round(v).toLocaleString("en-US"));
const signed = (value, digits, unit) =>
  known(value, (v) => `${v < 0 ? "−" : "+"}${Math.abs(v).toFixed(digits)} ${unit}`);

function fillSelect(select, choices, chosen) {
  select.replaceChildren(...choices.map(([value, text]) => element("option", { value }, text)));
  if (choices.some(([value]) => value === chosen)) select.value = chosen;
}

function row(head, ...cells) {
  const tr = element("tr", {}, element("th", { scope: "row" }, head));
  for (const cell of cells) tr.append(cell instanceof Node ? cell : element("td", {}, String(cell)));
  return tr;
}

const numberCell = (text) => element("td", { class: "number" }, text);

// Problems are told on the page, and what else there is still works.
function tell(text, bad = true) {
  $("problems").hidden = false;
  $("problems").append(element("p", { class: bad ? "note bad" : "note" }, text));
}

async function section(name, fill) {
  try {
    await fill();
  } catch (error) {
    tell(`${name} cannot be shown: ${error.message}`);
  }
}

function themeButton(changed) {
  const root = document.documentElement;
  const light = matchMedia("(prefers-color-scheme: light)").matches;
  root.dataset.theme = light ? "light" : "dark";
  $("theme").addEventListener("click", () => {
    root.dataset.theme = root.dataset.theme === "light" ? "dark" : "light";
    changed();
  });
}

const cssColour = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
