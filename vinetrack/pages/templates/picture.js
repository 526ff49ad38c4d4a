// The picture: frames of the chosen recording, the growth axis dragged on it, and its scale.
import {$, ask, changed, decimals, el, listed, numberOf, round, state, url} from "./state.js";

const view = {source: "", frame: 0, tool: "axis", image: null, width: 1, height: 1, board: "", words: "", edge: null};
const LENS = 7; // Screen pixels per pixel of the picture.
const MM = {mm: 1, cm: 10, in: 25.4};
let lengthUnit = "mm";
let askedFor = "";

export const row = () => state.sheet.rows[state.chosen];
export const shownFrame = () => view.frame;

export async function showRecording() {
  const recording = row()?.video ?? "";
  askedFor = recording;
  state.clip = null;
  view.source = "";
  view.words = "";
  Object.assign(curve, {key: "", path_px: null, drawn: curve.asked});
  drawSources();
  $("three").replaceChildren();
  $("stage").replaceChildren(el("p", {class: "busy tool"}, recording ? `Decoding ${recording} …` : "No recording in this row."));
  if (!recording) return;
  try {
    const clip = await ask(url("api/clip", {recording}));
    if (askedFor !== recording) return;
    state.clip = clip;
    view.frame = Math.floor(clip.frames / 2);
    $("frame").max = clip.frames - 1;
    drawPicture();
  } catch (error) {
    if (askedFor === recording) $("stage").replaceChildren(el("p", {class: "tool"}, error.message));
  }
}

function drawSources() {
  $("source").replaceChildren(el("option", {value: ""}, row()?.video || "no recording"), ...state.pictures.map((name) => el("option", {value: name, selected: name === view.source}, name)));
  $("source").onchange = (event) => { view.source = event.target.value; drawPicture(); };
}

const imageOf = (frame) => (view.source ? url("api/picture", {picture: view.source}) : url("api/frame", {recording: row().video, frame}));

function showNumber() {
  $("frame").value = view.frame;
  $("frame-at").textContent = `${view.frame} of ${state.clip.frames - 1}`;
}

export function showFrame(frame, edge = null) {
  view.frame = Math.max(0, Math.min(state.clip.frames - 1, frame));
  view.edge = edge;
  if (view.source) { view.source = ""; drawSources(); drawPicture(); return; }
  showNumber();
  if (view.image) view.image.src = imageOf(view.frame);
  drawOver();
}

export function drawPicture() {
  if (!state.clip) return;
  const image = el("img", {alt: view.source || `Frame ${view.frame} of ${row().video}`, draggable: "false", src: imageOf(view.frame)});
  view.image = image;
  image.onload = () => {
    Object.assign(view, {width: image.naturalWidth, height: image.naturalHeight});
    drawOver();
  };
  const over = el("svg", {id: "over", preserveAspectRatio: "none"});
  $("stage").replaceChildren(image, over);
  over.addEventListener("pointerdown", place);
  over.addEventListener("pointermove", (event) => { if (view.tool === "scale" && scaleKind() === "two_points") lens(event); });
  over.addEventListener("pointerleave", () => document.querySelector(".lens")?.remove());
  $("frame").disabled = Boolean(view.source);
  showNumber();
  $("frame").oninput = (event) => showFrame(Number(event.target.value));
  for (const radio of document.querySelectorAll("input[name=tool]")) {
    radio.onchange = () => { view.tool = radio.value; $("axis-tool").hidden = view.tool !== "axis"; $("scale-tool").hidden = view.tool !== "scale"; drawOver(); drawTools(); };
  }
  const frames = [0, Math.floor((state.clip.frames - 1) / 2), state.clip.frames - 1];
  $("three").replaceChildren(...frames.map((frame, i) => el("button", {type: "button", "data-frame": frame, onclick: () => showFrame(frame)},
    el("img", {src: url("api/frame", {recording: row().video, frame}), alt: ""}), el("svg", {viewBox: `0 0 ${state.clip.width} ${state.clip.height}`, preserveAspectRatio: "none"}),
    el("span", {}, `${["First", "Middle", "Last"][i]} frame, ${frame}`))));
  drawTools();
}

// ---- the axis ----------------------------------------------------------------------------------------------------

function ofCell(text) {
  const parts = (text ?? "").split(":").map((part) => part.split(",").map(Number));
  const points = parts.filter((part) => part.length === 2);
  if (points.length < 2 || !parts.every((part) => part.every(Number.isFinite))) return null;
  const width = parts.at(-1).length === 1 ? parts.at(-1)[0] : undefined;
  return {from_px: points[0], to_px: points.at(-1), via_px: points.slice(1, -1), width};
}

export function currentAxis() {
  const own = ofCell(row()?.axis);
  if (own) return {...own, given: "trial"};
  if (state.axis) return {...state.axis, given: "all"};
  return state.clip?.axis ? {...state.clip.axis, given: ""} : null;
}

function redraw() {
  drawOver();
  drawTools();
}

const rounded = (point) => point.map((v) => round(v));

function setAxis(axis, scope) {
  const ends = {from_px: rounded(axis.from_px), to_px: rounded(axis.to_px)};
  if (axis.via_px?.length) ends.via_px = axis.via_px.map(rounded);
  if (scope === "trial") {
    const width = axis.width ? `:${axis.width}` : "";
    row().axis = `${[ends.from_px, ...(ends.via_px ?? []), ends.to_px].map((point) => point.join(",")).join(":")}${width}`;
    if (!state.sheet.columns.includes("axis")) state.sheet.columns.push("axis");
  } else {
    state.axis = {...(state.axis?.width_mm ? {width_mm: state.axis.width_mm} : {}), ...ends};
    if (row().axis) row().axis = "";
  }
  changed();
  redraw();
}

// Change points of the axis, in the scope that it has or that is chosen.
function changeAxis(points) {
  const now = currentAxis();
  setAxis({...now, ...points}, now.given || ($("axis-scope")?.value ?? "all"));
}

const pointsOf = (axis) => [axis.from_px, ...(axis.via_px ?? []), axis.to_px];

// Points along an axis in order: its ends, or those of the curve that the tracker lays through its bends. While the
// server is asked for it the former curve stays; there is none through points that coincide.
const curve = {key: "", path_px: null, asked: 0, drawn: 0};
export function placesOf(axis) {
  if (axis.path_px || !axis.via_px?.length) return axis.path_px ?? pointsOf(axis);
  const key = pointsOf(axis).join(";");
  if (key !== curve.key) {
    curve.key = key;
    const turn = ++curve.asked;
    const draw = (path_px) => { if (turn > curve.drawn) { Object.assign(curve, {path_px, drawn: turn}); drawOver(); } };
    ask(url("api/curve", {points: key})).then((made) => draw(made.path_px), () => draw(null));
  }
  return curve.path_px ?? pointsOf(axis);
}

function addBend() {
  const now = currentAxis(), points = pointsOf(now), path = placesOf(now);
  const apart = ([x0, y0], [x1, y1]) => Math.hypot(x1 - x0, y1 - y0);
  const lengths = points.slice(1).map((point, i) => apart(points[i], point));
  const i = lengths.indexOf(Math.max(...lengths));
  // In the middle of the longest segment: on the curve, if there is one.
  const nearest = (point) => path.reduce((best, one, k) => (apart(one, point) < apart(path[best], point) ? k : best), 0);
  const middle = points[i].map((v, k) => (v + points[i + 1][k]) / 2);
  const bend = path.length > 2 ? path[Math.round((nearest(points[i]) + nearest(points[i + 1])) / 2)] : middle;
  changeAxis({via_px: (now.via_px ?? []).toSpliced(i, 0, bend)});
  focusOn(bendWords(i));
}

function removeBend(i) {
  changeAxis({via_px: currentAxis().via_px.toSpliced(i, 1)});
  focusOn(currentAxis().via_px?.length ? bendWords(Math.max(i - 1, 0)) : AXIS_ENDS.from_px);
}

const AXIS_ENDS = {from_px: "Start of the growth axis", to_px: "End of the growth axis"};
const bendWords = (i) => `Bend ${i + 1} of the growth axis`;
const focusOn = (words) => document.querySelector(`[data-handle="${words}"]`)?.focus();

function clearAxis() {
  if (row().axis) row().axis = "";
  else state.axis = null;
  changed();
  redraw();
}

// ---- what is drawn over the picture ------------------------------------------------------------------------------

export function drawOver() {
  const over = $("over");
  if (!over || !state.clip) return;
  // Keep the focus when redrawing: a frame may arrive while its edge is moved with the keyboard.
  const held = over.contains(document.activeElement) ? document.activeElement.dataset.handle : "";
  over.setAttribute("viewBox", `0 0 ${view.width} ${view.height}`);
  $("stage").classList.toggle("scale", view.tool === "scale");
  over.replaceChildren();
  const unit = view.width / Math.max($("stage").clientWidth, 1);
  const axis = currentAxis();
  if (axis && !view.source) drawAxis(over, axis, unit, view.tool === "axis");
  for (const button of $("three").children) {
    button.setAttribute("aria-pressed", Number(button.dataset.frame) === view.frame && !view.source);
    const small = button.querySelector("svg");
    small.replaceChildren();
    if (axis) drawAxis(small, axis, state.clip.width / Math.max(button.clientWidth, 1), false);
  }
  if (view.tool === "scale" && scaleKind() === "two_points") drawMarks(over, unit);
  if (view.edge && !view.source) {
    const {line, middle, put} = view.edge;
    over.append(el("line", {...line, class: "edge-line", "stroke-width": 2 * unit}), knob(8 * unit, unit, true, "Leading edge in this frame", middle, put));
  }
  if (held) focusOn(held);
}

function drawAxis(over, axis, unit, handles) {
  const kind = axis.given ? "axis-line given" : "axis-line proposed";
  const places = placesOf(axis);
  const [[x0, y0], [x1, y1]] = places.slice(-2);
  if (places.length > 2) over.append(el("polyline", {class: kind, fill: "none", points: places.slice(0, -1).join(" "), "stroke-width": 2 * unit}));
  const line = (cls, dx, dy, width) => el("line", {class: cls, x1: x0 + dx, y1: y0 + dy, x2: x1 + dx, y2: y1 + dy, "stroke-width": width * unit});
  const length = Math.hypot(x1 - x0, y1 - y0) || 1;
  const [ux, uy] = [(x1 - x0) / length, (y1 - y0) / length];
  const half = (axis.width_px ?? 0) / 2;
  if (half && places.length === 2) for (const side of [-half, half]) over.append(line(`${kind} side`, -side * uy, side * ux, 1));
  over.append(line(kind, 0, 0, 2));
  const tip = 11 * unit;
  over.append(el("path", {class: kind, "stroke-width": 2 * unit, d: `M${x1 - tip * (ux + 0.5 * uy)} ${y1 - tip * (uy - 0.5 * ux)} L${x1} ${y1} L${x1 - tip * (ux - 0.5 * uy)} ${y1 - tip * (uy + 0.5 * ux)}`}));
  if (!handles) return;
  for (const [end, words] of Object.entries(AXIS_ENDS)) {
    over.append(knob(8 * unit, unit, axis.given, words, () => currentAxis()[end], (point) => changeAxis({[end]: point})));
  }
  (axis.via_px ?? []).forEach((_, i) => {
    const put = (place) => changeAxis({via_px: currentAxis().via_px.with(i, place)});
    const made = knob(6 * unit, unit, axis.given, bendWords(i), () => currentAxis().via_px[i], put, "Delete removes it");
    made.addEventListener("keydown", (event) => { if (["Delete", "Backspace"].includes(event.key)) { event.preventDefault(); removeBend(i); } });
    over.append(made);
  });
}

function knob(r, unit, given, words, where, put, more) {
  const [cx, cy] = where();
  return handle("circle", {cx, cy, r, "stroke-width": 2 * unit, class: given ? "handle given" : "handle"}, words, where, put, more);
}

function handle(tag, given, words, where, put, more = "") {
  const made = el(tag, {...given, tabindex: 0, role: "button", "aria-label": `${words}; arrow keys move it by a pixel, with Shift by ten, with Alt by a tenth${more && `; ${more}`}`, "data-handle": words});
  made.addEventListener("pointerdown", (event) => { event.stopPropagation(); event.preventDefault(); drag(event, words, put); });
  made.addEventListener("keydown", (event) => {
    const step = event.shiftKey ? 10 : event.altKey ? 0.1 : 1;
    const by = {ArrowLeft: [-step, 0], ArrowRight: [step, 0], ArrowUp: [0, -step], ArrowDown: [0, step]}[event.key];
    if (!by) return;
    event.preventDefault();
    const [x, y] = where();
    put(inside([x + by[0], y + by[1]]));
    focusOn(words);
  });
  return made;
}

const inside = ([x, y]) => [Math.min(Math.max(x, 0), view.width - 1), Math.min(Math.max(y, 0), view.height - 1)];

function at(event) {
  const box = $("over").getBoundingClientRect();
  // Pixel centres are at integers.
  return inside([((event.clientX - box.left) / box.width) * view.width - 0.5, ((event.clientY - box.top) / box.height) * view.height - 0.5]);
}

function drag(event, words, put) {
  const over = $("over");
  over.setPointerCapture(event.pointerId);
  const move = (next) => { lens(next); put(at(next)); };
  const end = () => {
    over.removeEventListener("pointermove", move);
    document.querySelector(".lens")?.remove();
    focusOn(words);
  };
  over.addEventListener("pointermove", move);
  over.addEventListener("pointerup", end, {once: true});
  over.addEventListener("pointercancel", end, {once: true});
}

function lens(event) {
  const glass = document.querySelector(".lens") ?? $("stage").appendChild(el("div", {class: "lens", "aria-hidden": "true"}));
  const [x, y] = at(event);
  const box = $("stage").getBoundingClientRect();
  const [left, top] = [event.clientX - box.left, event.clientY - box.top];
  glass.style.left = `${Math.min(Math.max(left + (left > box.width / 2 ? -190 : 40), 0), box.width - 150)}px`;
  glass.style.top = `${Math.min(Math.max(top - 75, 2), Math.max(box.height - 152, 2))}px`;
  glass.style.backgroundImage = `url("${view.image.src}")`;
  glass.style.backgroundSize = `${view.width * LENS}px ${view.height * LENS}px`;
  glass.style.backgroundPosition = `${73 - (x + 0.5) * LENS}px ${73 - (y + 0.5) * LENS}px`;
}

// ---- the scale ---------------------------------------------------------------------------------------------------

const marks = {from_px: null, to_px: null, length: "", square: "", marker: "", own: ""};
let kind = null;

export function readCalibration() {
  const given = state.calibration;
  kind = given?.kind ?? "two_points";
  if (given?.kind === "two_points") Object.assign(marks, {from_px: given.from_px, to_px: given.to_px, length: String(given.length_mm)});
  if (given?.kind === "mm_per_px") marks.own = String(given.mm_per_px);
  if (given?.squares) Object.assign(marks, {square: String(given.square_mm), marker: String(given.marker_mm ?? ""), board: given});
}

const scaleKind = () => (kind === "checkerboard" || kind === "charuco" ? "board" : kind);

function place(event) {
  if (view.tool !== "scale" || scaleKind() !== "two_points") return;
  const end = Object.keys(MARKS).find((key) => !marks[key]);
  if (!end) return;
  setMark(end, at(event));
  // Pressing moves the focus to the pressed element.
  if (marks.to_px) addEventListener("pointerup", () => setTimeout(() => $("length")?.focus()), {once: true});
}

const MARKS = {from_px: "First ruler mark", to_px: "Second ruler mark"};

function setMark(end, point) {
  marks[end] = rounded(point);
  writeScale();
  redraw();
}

function drawMarks(over, unit) {
  const [from, to] = [marks.from_px, marks.to_px];
  if (from && to) over.append(el("line", {class: "ruler-line", x1: from[0], y1: from[1], x2: to[0], y2: to[1], "stroke-width": 1.5 * unit}));
  for (const [end, words] of Object.entries(MARKS)) {
    if (!marks[end]) continue;
    const [x, y] = marks[end];
    const r = 9 * unit;
    const d = `M${x - r} ${y}H${x + r}M${x} ${y - r}V${y + r}M${x - r * 0.6} ${y}a${r * 0.6} ${r * 0.6} 0 1 0 ${r * 1.2} 0a${r * 0.6} ${r * 0.6} 0 1 0 ${-r * 1.2} 0`;
    over.append(handle("path", {class: "mark", "stroke-width": 1.6 * unit, d}, words, () => marks[end], (point) => setMark(end, point)));
  }
}

function writeScale() {
  const length = numberOf(marks.length) * MM[lengthUnit];
  if (kind === "two_points") state.calibration = marks.from_px && marks.to_px && length > 0 ? {kind, from_px: marks.from_px, to_px: marks.to_px, length_mm: round(length, 4)} : null;
  if (kind === "mm_per_px") state.calibration = numberOf(marks.own) > 0 ? {kind, mm_per_px: numberOf(marks.own)} : null;
  if (scaleKind() === "board") {
    const {board} = marks;
    const [square, marker] = [numberOf(marks.square), numberOf(marks.marker)];
    const whole = board && square > 0 && (board.kind === "checkerboard" || marker > 0);
    const markers = board?.kind === "charuco" ? {marker_mm: marker, dictionary: board.dictionary} : {};
    state.calibration = whole ? {kind: board.kind, image: board.image, squares: board.squares, square_mm: square, ...markers} : null;
  }
  changed();
}

function mmPerPx() {
  const given = state.calibration;
  if (given?.kind === "mm_per_px") return given.mm_per_px;
  if (given?.kind !== "two_points") return null;
  return given.length_mm / Math.hypot(given.to_px[0] - given.from_px[0], given.to_px[1] - given.from_px[1]);
}

async function findBoard() {
  const picture = view.source || row().video;
  view.words = "busy";
  drawTools();
  try {
    const board = await ask(url("api/board", {picture}));
    view.words = board ? "" : `No printed board found in ${picture}: it must be fully visible, in focus and not mirrored.`;
    if (board) { marks.board = board; kind = board.kind; if (numberOf(marks.square)) marks.marker = suggested(); writeScale(); }
  } catch (error) {
    view.words = error.message;
  }
  drawTools();
}

const suggested = () => (marks.board?.marker_share ? String(round(numberOf(marks.square) * marks.board.marker_share, 1)) : "");

// ---- words and fields below the picture --------------------------------------------------------------------------

function said(field) {
  const found = state.problems.filter((problem) => problem.field === field || (problem.field === "cell" && problem.column === field && problem.trial === row()?.trial));
  return el("ul", {class: "problems"}, ...listed(found));
}

function field(id, label, value, write, more = {}) {
  return el("label", {}, `${label} `, el("input", {id, type: "text", value, inputmode: "decimal", autocomplete: "off", ...more, oninput: (event) => { write(event.target.value); writeScale(); facts(); }}));
}

export function drawTools() {
  if (!state.clip) return;
  drawAxisTool();
  drawScaleTool();
}

// Keep the fields: the user may be typing in one.
export function drawProblems() {
  for (const [tool, name] of [["axis-tool", "axis"], ["scale-tool", "calibration"]]) $(tool).querySelector(".problems")?.replaceWith(said(name));
}

function drawAxisTool() {
  const axis = currentAxis();
  const words = {
    "": axis ? "Found from the motion of this recording. Nothing is written: the axis of each recording is found separately. Drag an end if it is wrong." : `No axis found: ${state.clip.no_axis}.`,
    all: "Given for all trials, in experiment.yaml.", trial: `Given for ${row().trial} alone, in its row.`,
  }[axis?.given ?? ""];
  const ends = axis ? [axis.from_px, axis.to_px].map((end) => rounded(end).join(", ")).join(" to ") : "";
  const scope = el("select", {id: "axis-scope", onchange: (event) => { if (axis?.given) setAxis(axis, event.target.value); }},
    el("option", {value: "all", selected: axis?.given !== "trial"}, "all trials"), el("option", {value: "trial", selected: axis?.given === "trial"}, "this trial alone"));
  const {width, height} = state.clip;
  const place = () => setAxis({from_px: [0.1 * width, height / 2], to_px: [0.9 * width, height / 2]}, "all");
  const moved = Object.values(state.corrections).flat().filter((one) => one.action === "move").length;
  const warning = moved ? el("p", {class: "hint", id: "moved-points", role: "note"}, `${moved === 1 ? "A moved point refers" : `${moved} moved points refer`} to the former axis: after a change of the axis, move them again.`) : null;
  $("axis-tool").replaceChildren(...[said("axis"), el("p", {class: "hint"}, words), warning].filter(Boolean), el("div", {class: "row"},
    axis ? el("span", {class: "fact"}, el("b", {}, ends), " px") : el("button", {type: "button", onclick: place}, "Draw one"),
    axis ? el("button", {type: "button", class: "plain", id: "add-bend", onclick: addBend, title: "Adds a point in the middle of the longest segment; drag it to where the vine bends. Delete removes a point."}, "Add a bend") : null,
    axis?.via_px?.length ? el("button", {type: "button", class: "plain", id: "straighten", onclick: () => changeAxis({via_px: []})}, "Make it straight") : null,
    el("label", {}, "A dragged axis applies to ", scope), axis?.given ? el("button", {type: "button", class: "plain", onclick: clearAxis}, "Use the axis found from the motion") : null));
}

function facts() {
  const scale = mmPerPx();
  const apart = marks.from_px && marks.to_px ? Math.hypot(marks.to_px[0] - marks.from_px[0], marks.to_px[1] - marks.from_px[1]) : null;
  const words = [];
  if (kind === "two_points" && apart) words.push(`${decimals(apart, 4)} px apart`);
  if (scale) words.push(`${decimals(scale, 4)} mm a pixel`, `the picture is ${decimals(scale * state.clip.width, 3)} mm wide`);
  if (view.source && (view.width !== state.clip.width || view.height !== state.clip.height)) {
    words.push(`this picture is ${view.width} × ${view.height} px, the recording ${state.clip.width} × ${state.clip.height}: take it with the camera's settings of the trials`);
  }
  const place = $("scale-facts");
  if (place) place.textContent = words.join("; ");
}

function drawScaleTool() {
  const kinds = [["two_points", "Two marks on a ruler"], ["board", "A printed board"], ["mm_per_px", "The scale itself"]];
  const choose = (value) => { kind = value === "board" ? marks.board?.kind ?? "charuco" : value; writeScale(); redraw(); };
  const segments = el("div", {class: "segments", role: "radiogroup", "aria-label": "Where the scale comes from"}, ...kinds.map(([value, words]) =>
    el("label", {}, el("input", {type: "radio", name: "scale", id: `scale-${value}`, value, checked: scaleKind() === value, onchange: () => choose(value)}), words)));
  const parts = [];
  if (kind === "two_points") {
    const step = !marks.from_px ? "Click the first mark of a ruler that lies in the plane of growth." : !marks.to_px ? "Click the second mark, as far away as the ruler allows." : "Drag a mark, or move it with the arrow keys.";
    parts.push(el("p", {class: "hint"}, step), el("div", {class: "row"},
      field("length", "Length between them", marks.length, (value) => { marks.length = value; }),
      el("select", {id: "length-unit", "aria-label": "Unit of the length", onchange: (event) => { lengthUnit = event.target.value; writeScale(); facts(); }}, ...Object.keys(MM).map((unit) => el("option", {value: unit, selected: unit === lengthUnit}, unit))),
      marks.from_px ? el("button", {type: "button", class: "plain", onclick: () => { Object.assign(marks, {from_px: null, to_px: null}); writeScale(); redraw(); }}, "Click both again") : null));
  } else if (kind === "mm_per_px") {
    parts.push(el("div", {class: "row"}, field("own-scale", "Millimetres per pixel", marks.own, (value) => { marks.own = value; })));
  } else {
    const {board} = marks;
    parts.push(el("div", {class: "row"}, el("button", {type: "button", id: "find-board", onclick: findBoard}, "Look for a board here"),
      view.words === "busy" ? el("span", {class: "busy"}, "looking …") : board ? el("span", {class: "fact"}, el("b", {}, `${board.kind === "charuco" ? "ChArUco board" : "Checkerboard"}, ${board.squares.join(" × ")} squares`), board.dictionary ? ` of ${board.dictionary}` : "", ` in ${board.image}`) : el("span", {class: "muted"}, view.words || "Choose its picture above, or a recording that shows it in its first frame.")));
    if (board) {
      parts.push(el("div", {class: "row"}, field("square", "Side of a square, mm", marks.square, (value) => { marks.square = value; if (board.marker_share) { marks.marker = suggested(); if ($("marker")) $("marker").value = marks.marker; } }),
        board.kind === "charuco" ? field("marker", "of a marker, mm", marks.marker, (value) => { marks.marker = value; }) : null, el("span", {class: "muted"}, "measured on the print")));
    }
  }
  $("scale-tool").replaceChildren(said("calibration"), el("div", {class: "row"}, segments), ...parts, el("p", {class: "fact muted", id: "scale-facts"}));
  facts();
}
