// State of the page, requests to the server, and creation of elements.
export const state = {
  known: {}, units: {}, offered: [], sheet: {columns: [], rows: []}, kept: [], shared: {}, calibration: null, axis: null, corrections: {},
  pictures: [], traces: [], notes: [], stamp: "", chosen: 0, problems: [], dirty: false, compared: false, clip: null,
};

export const $ = (id) => document.getElementById(id);

export function el(tag, given = {}, ...children) {
  const svg = ["svg", "image", "line", "circle", "path", "text", "polyline"].includes(tag);
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", tag) : document.createElement(tag);
  for (const [key, value] of Object.entries(given)) {
    if (key.startsWith("on")) made.addEventListener(key.slice(2), value);
    else if (value === true) made.setAttribute(key, "");
    else if (value !== false && value !== null && value !== undefined) made.setAttribute(key, value);
  }
  made.append(...children.filter((child) => child !== null && child !== undefined));
  return made;
}

export async function ask(path, body) {
  const options = body === undefined ? {} : {
    method: "POST", body: JSON.stringify(body), headers: {"Content-Type": "application/json", "X-Vinetrack": "setup"},
  };
  const answer = await fetch(path, options).catch(() => { throw new Error("The program has ended: start vinetrack setup again; nothing here is saved."); });
  const content = await answer.json().catch(() => ({}));
  if (!answer.ok) throw Object.assign(new Error(content.words || `The server returned status ${answer.status}.`), {content});
  return content;
}

export const problemsOf = (error) => error.content?.problems ?? [{severity: "error", field: "whole", text: error.message}];
export const url = (path, given) => `${path}?${new URLSearchParams(given)}`;

export const quantityOf = (name) => state.known[name]?.quantity ?? name;

// Columns shown: those of the sheet and those offered, each quantity once, in its unit in the sheet.
export function shownColumns() {
  const names = state.sheet.columns.filter((name) => !["trial", "video"].includes(name));
  for (const name of [...Object.keys(state.shared), ...state.offered]) {
    if (!names.some((one) => quantityOf(one) === quantityOf(name))) names.push(name);
  }
  const offered = state.offered.map(quantityOf);
  const order = (name) => (offered.includes(quantityOf(name)) ? offered.indexOf(quantityOf(name)) : offered.length);
  return names.sort((a, b) => order(a) - order(b));
}

// Display name of a column: without its unit if that can be chosen.
export function labelOf(name) {
  const known = state.known[name];
  return (known && known.units.length > 1 ? known.quantity : name).replaceAll("_", " ");
}

// The name, in whichever unit, under which all trials share a quantity.
export const sharedKey = (name) => Object.keys(state.shared).find((key) => quantityOf(key) === quantityOf(name));
export const sharedValue = (name) => state.shared[sharedKey(name)] ?? "";

// Empty columns are not written, unless the sheet had them.
export function content(more = {}) {
  const {rows} = state.sheet;
  const columns = state.sheet.columns.filter((name) => state.kept.includes(name) || rows.some((row) => row[name]));
  const {shared, calibration, axis, corrections, stamp} = state;
  return {sheet: {columns, rows}, shared, calibration, axis, corrections, stamp, ...more};
}

export const listeners = [];
let waiting;
export function changed() {
  state.dirty = true;
  state.compared = false;
  clearTimeout(waiting);
  waiting = setTimeout(() => listeners.forEach((listener) => listener()), 350);
}

// Avoid a second check when one is already pending.
export const settle = () => clearTimeout(waiting);

// Problems as items of a list.
export const listed = (problems) => problems.map(({severity, text}) => el("li", {class: severity}, text));

export const decimals = (value, digits) => (value === null || value === undefined ? "–" : Number(value.toPrecision(digits)).toString());
export const numberOf = (text) => { const value = parseFloat(String(text).replace(",", ".")); return Number.isFinite(value) ? value : null; };
export const round = (value, digits = 1) => Math.round(value * 10 ** digits) / 10 ** digits;
