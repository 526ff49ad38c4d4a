// The table: one row for all trials, one for each trial, with problems under the cell concerned.
import {$, ask, changed, el, labelOf, listed, quantityOf, sharedKey, sharedValue, shownColumns, state, url} from "./state.js";

export function drawTable() {
  const columns = shownColumns();
  const table = $("trials");
  table.replaceChildren(head(columns), el("tbody", {}, sharedRow(columns), ...state.sheet.rows.map((row, i) => trialRow(row, i, columns))));
  table.onpaste = paste;
  table.onkeydown = move;
  $("notes").replaceChildren(el("option", {value: ""}, "…"), ...state.notes.map((name) => el("option", {value: name}, name)));
  $("notes").parentElement.hidden = !state.notes.length;
  $("notes").onchange = ({target}) => { propose({file: target.value}, "", 0); target.value = ""; }; // to be read again
  $("other-notes").onchange = async ({target}) => { await propose({text: await target.files[0].text()}, "", 0); target.value = ""; };
  $("traces").replaceChildren(...state.traces.map((name) => el("option", {value: name})));
  drawAdder(columns);
  markProblems();
}

function head(columns) {
  const cells = columns.map((name) => {
    const known = state.known[name];
    const title = known ? [known.meaning, known.measured, known.default && `Blank: ${known.default}.`].filter(Boolean).join(" ") : "Not a column of a trial sheet: kept, but ignored.";
    const unit = known && known.units.length > 1
      ? el("select", {"aria-label": `Unit of ${known.quantity}`, onchange: (event) => correctUnit(name, event.target.value)},
        ...known.units.map((key) => el("option", {value: key, selected: name === `${known.quantity}_${key}`}, state.units[key])))
      : el("span", {class: "unit"});
    return el("th", {scope: "col"}, el("span", {title}, labelOf(name)), unit);
  });
  return el("thead", {}, el("tr", {}, el("td"), el("th", {scope: "col"}, "trial", el("span", {class: "unit"}, "recording")), ...cells));
}

// Who chooses a unit corrects what was typed.
function correctUnit(name, unit) {
  remember();
  setUnit(name, unit);
  const words = `${labelOf(name)}: the numbers stay as they were typed, and are ${state.units[unit]} now; Ctrl-Z takes that back.`;
  $("pasted").replaceChildren(...listed([{severity: "note", text: words}]));
  $("trials").querySelector(`[aria-label="Unit of ${quantityOf(name)}"]`).focus();
}

function setUnit(name, unit) {
  const other = `${quantityOf(name)}_${unit}`;
  for (const [place, key] of [[state.sheet, "columns"], [state, "kept"], [state, "offered"]]) {
    place[key] = place[key].map((column) => (column === name ? other : column));
  }
  const rename = (cells, from) => { if (from in cells && from !== other) { cells[other] = cells[from]; delete cells[from]; } };
  for (const row of state.sheet.rows) rename(row, name);
  rename(state.shared, sharedKey(name));
  changed();
  drawTable();
}

function sharedRow(columns) {
  const cells = columns.map((name) => {
    const known = state.known[name];
    if (!known?.shared) return el("td");
    const key = sharedKey(name) ?? name;
    const blank = known.default.startsWith("required") ? "" : known.default.split(":")[0].slice(0, 12);
    return cell(name, "shared", state.shared[key] ?? "", blank, (value) => {
      state.shared[key] = value;
      for (const field of $("trials").querySelectorAll(`tbody tr:not(.all) input[data-column="${name}"]`)) field.placeholder = value;
    });
  });
  return el("tr", {class: "all"}, el("td", {class: "pic"}), el("td", {class: "label"}, "All trials"), ...cells);
}

function trialRow(row, i, columns) {
  const picture = row.video
    ? el("button", {type: "button", class: "pick", title: `Show ${row.video}`, "aria-label": `Show ${row.trial}`},
      el("img", {src: url("api/thumbnail", {recording: row.video}), alt: "", loading: "lazy"}))
    : null;
  const name = cell("trial", i, row.trial ?? "", "", (value) => {
    // Corrections follow the name of their trial.
    if (state.corrections[row.trial] && value !== row.trial) { state.corrections[value] = state.corrections[row.trial]; delete state.corrections[row.trial]; }
    row.trial = value;
  });
  name.classList.add("name");
  name.append(el("small", {class: "file"}, row.video || row.track || ""));
  const cells = columns.map((column) => cell(column, i, row[column] ?? "", sharedValue(column), (value) => setCell(row, column, value)));
  return el("tr", {"data-row": i, class: i === state.chosen ? "chosen" : ""}, el("td", {class: "pic"}, picture), name, ...cells);
}

function setCell(row, column, value) {
  row[column] = value;
  if (!state.sheet.columns.includes(column)) state.sheet.columns.push(column);
}

function cell(column, row, value, placeholder, write) {
  const known = state.known[column];
  const label = `${labelOf(column)}, ${row === "shared" ? "all trials" : state.sheet.rows[row].trial}`;
  const given = {"data-column": column, "data-quantity": quantityOf(column), "data-row": row, "aria-label": label};
  const heard = (event) => { write(event.target.value.trim()); changed(); };
  const field = known?.kind === "yes_no"
    ? el("select", {...given, onchange: heard}, ...["", "yes", "no"].map((word) => el("option", {value: word, selected: word === value}, word)))
    : el("input", {...given, type: "text", value, placeholder, spellcheck: "false", autocomplete: "off", list: column === "pressure_trace" ? "traces" : null, inputmode: known?.kind === "number" ? "decimal" : "text", oninput: heard});
  return el("td", {class: known?.kind === "number" ? "" : "text"}, field);
}

function move(event) {
  const field = event.target;
  const step = {ArrowDown: 1, ArrowUp: -1, Enter: 1}[event.key];
  if (!step || !field.matches("input")) return;
  const column = [...$("trials").querySelectorAll(`[data-column="${field.dataset.column}"]`)];
  const next = column[column.indexOf(field) + step];
  if (next) { next.focus(); next.select?.(); event.preventDefault(); }
}

function paste(event) {
  const text = event.clipboardData.getData("text");
  const {column, row} = event.target.dataset;
  const isText = state.known[column] && state.known[column].kind !== "number";
  if (!/[\t\n]/.test(text.trim()) && (isText || !/;|,\s*\S+[,\s]|,\s+\S/.test(text))) return;
  event.preventDefault();
  propose({text}, column, row);
}

// The server says which cells a block changes. They are shown first, and Ctrl-Z takes the whole block back.
let before = null;
const remember = () => { before = structuredClone({sheet: state.sheet, shared: state.shared, kept: state.kept, offered: state.offered}); };
async function propose(block, column, row) {
  const {rows, decimal} = state.sheet;
  const at_row = row === "shared" ? row : Number(row);
  let placed;
  try {
    placed = await ask("api/paste", {...block, columns: shownColumns(), rows: rows.map((one) => ({...one, ...state.shared})), at_row, at_column: column, decimal: decimal || "."});
  } catch (error) {
    placed = {cells: [], notes: [error.message]};
  }
  const valueNow = (at, name) => (at === "shared" ? sharedValue(name) : rows[at][name]) ?? "";
  const cells = placed.cells.filter(([at, name, value]) => valueNow(at, name) !== value);
  $("pasted").replaceChildren(...listed(placed.notes.map((text) => ({severity: "warning", text}))));
  $("preview").hidden = !cells.length;
  $("changes").replaceChildren(...cells.map(([at, name, value]) => {
    return el("tr", {}, ...[at === "shared" ? "All trials" : rows[at].trial, name.replaceAll("_", " "), valueNow(at, name) || "blank", "→", value].map((text) => el("td", {}, text)));
  }));
  $("put-in").textContent = `Fill in ${cells.length} cells`;
  $("put-in").onclick = () => {
    remember();
    for (const name of new Set(cells.map((one) => one[1]))) {
      const shown = shownColumns().find((one) => quantityOf(one) === quantityOf(name)) ?? name;
      if (shown !== name) setUnit(shown, name.slice(quantityOf(name).length + 1));
    }
    for (const [at, name, value] of cells) {
      if (at === "shared") state.shared[sharedKey(name) ?? name] = value;
      else setCell(state.sheet.rows[at], name, value);
    }
    $("preview").hidden = true;
    refreshAt(column, row);
  };
  $("put-in").focus();
}

$("leave").onclick = () => { $("preview").hidden = true; $("pasted").replaceChildren(); };

const refreshAt = (column, row) => { changed(); drawTable(); $("trials").querySelector(`[data-column="${column}"][data-row="${row}"]`)?.focus(); };

addEventListener("input", () => { before = null; });
addEventListener("keydown", (event) => {
  if (!before || !(event.ctrlKey || event.metaKey) || event.key !== "z") return;
  event.preventDefault();
  Object.assign(state, before);
  before = null;
  $("pasted").replaceChildren();
  refreshAt(document.activeElement?.dataset.column, document.activeElement?.dataset.row);
});

function drawAdder(columns) {
  const shown = new Set(columns.map(quantityOf));
  const left = Object.keys(state.known).filter((name) => state.known[name].base === name && !shown.has(quantityOf(name)));
  $("add-column").replaceChildren(el("option", {value: ""}, "…"), ...left.map((name) => el("option", {value: name, title: state.known[name].meaning}, name)));
  $("add-column").onchange = (event) => {
    state.offered.push(event.target.value);
    drawTable();
    $("trials").querySelector(`[data-column="${event.target.value}"]`)?.focus();
  };
}

// Marks the cells with problems; returns the problems that no cell shows.
export function markProblems() {
  const placeless = [], told = new Set();
  for (const cell of $("trials").querySelectorAll("td")) {
    cell.classList.remove("bad", "odd");
    cell.querySelectorAll("small.said").forEach((words) => words.remove());
  }
  for (const {severity, field, trial, column, text, code, of_a_measurement} of state.problems) {
    if (!["cell", "row", "shared"].includes(field)) continue;
    const here = `[data-row="${field === "shared" ? field : state.sheet.rows.findIndex((one) => one.trial === trial)}"]`;
    const at = (name, more) => $("trials").querySelector(`[data-quantity="${quantityOf(name)}"]${more}`);
    // A column in neither file is missing for all trials; a problem without a cell is shown with its trial.
    const input = at(column, here) ?? at(column, "") ?? at("trial", here);
    if (!input) {
      placeless.push({severity, text});
      continue;
    }
    const blank = code === "missing" || code === "blank";
    if (blank && sharedValue(column)) continue;
    const cell = input.closest("td");
    cell.classList.add(severity === "error" ? "bad" : "odd");
    const alike = of_a_measurement ? `${severity} ${column}` : text, again = told.has(alike);
    told.add(alike);
    if (of_a_measurement && !again) placeless.push({severity, text: `${trial}: ${text}`}); // a cell may be scrolled away
    const short = blank ? "to be filled in" : again ? "likewise" : text.replace(new RegExp(`^${column} `), "");
    cell.append(el("small", {class: `said ${severity}`, title: text}, short));
    input.setAttribute("aria-invalid", severity === "error");
  }
  return placeless;
}
