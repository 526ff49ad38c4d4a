// The picture: frames of the chosen recording, the growth axis dragged on it, and its scale.
import {$, ask, changed, decimals, el, listed, numberOf, round, sharedValue, state, url} from "./state.js";
import {drawTable} from "./table.js";

const view = {source: "", frame: 0, image: null, width: 1, height: 1, edge: null};
const LENS = 7; // Screen pixels per pixel of the picture.
let askedFor = "";

// What is placed in the picture, and where the scale comes from.
const chosen = (name) => document.querySelector(`input[name=${name}]:checked`).value;
const placingMarks = () => chosen("tool") === "scale" && chosen("scale") === "two_points";

export const row = () => state.sheet.rows[state.chosen];
export const shownFrame = () => view.frame;

export async function showRecording() {
  const recording = askedFor = row()?.video ?? "";
  state.clip = null;
  view.source = "";
  [$("frame").disabled, $("track").disabled] = [true, !recording];
  Object.assign(curve, {key: "", path_px: null, drawn: curve.asked});
  drawSources();
  const none = row()?.track ? `${row().track} holds positions: there is no picture.` : "No recording in this row.";
  $("stage").replaceChildren(el("p", {class: recording ? "busy tool" : "tool"}, recording ? `Decoding ${recording} …` : none));
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
}

// A picture that is no recording is there for its scale.
function showPicture(name) {
  view.source = name;
  document.querySelector("input[name=tool][value=scale]").checked ||= Boolean(name);
  drawSources();
  drawPicture();
  if (name && !marks.from_px && !board) findTarget();
}

const imageOf = (frame) => (view.source ? url("api/picture", {picture: view.source}) : url("api/frame", {recording: row().video, frame}));

const showNumber = () => { [$("frame").value, $("frame-at").textContent] = [view.frame, view.source ? "" : `${view.frame} of ${state.clip.frames - 1}`]; };

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
  over.addEventListener("pointermove", (event) => { if (placingMarks()) lens(event); });
  over.addEventListener("pointerleave", () => document.querySelector(".lens")?.remove());
  $("frame").disabled = Boolean(view.source);
  showNumber();
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

const rounded = (point) => point.map((v) => round(v));

function setAxis(axis, scope) {
  const points = pointsOf(axis).map(rounded), via_px = points.slice(1, -1), {width_mm} = state.axis ?? {};
  if (scope === "trial") {
    row().axis = (axis.width ? [...points, axis.width] : points).join(":");
    if (!state.sheet.columns.includes("axis")) state.sheet.columns.push("axis");
  } else {
    state.axis = {...(width_mm && {width_mm}), from_px: points[0], to_px: points.at(-1), ...(via_px.length && {via_px})};
    if (row().axis) row().axis = "";
  }
  changed();
  redraw();
}

const redraw = () => { drawOver(); drawTools(); };

// Change points of the axis, in the scope that it has or that is chosen.
function changeAxis(points) {
  const now = currentAxis();
  setAxis({...now, ...points}, now.given || $("axis-scope").value);
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

// In the middle of the longest segment.
function addBend() {
  const now = currentAxis(), points = pointsOf(now);
  const lengths = points.slice(1).map(([x, y], i) => Math.hypot(x - points[i][0], y - points[i][1]));
  const i = lengths.indexOf(Math.max(...lengths));
  changeAxis({via_px: (now.via_px ?? []).toSpliced(i, 0, points[i].map((v, k) => (v + points[i + 1][k]) / 2))});
  focusOn(bendWords(i));
}

function removeBend(i) {
  changeAxis({via_px: currentAxis().via_px.toSpliced(i, 1)});
  focusOn(currentAxis().via_px?.length ? bendWords(Math.max(i - 1, 0)) : AXIS_ENDS.from_px);
}

const AXIS_ENDS = {from_px: "Start of the growth axis", to_px: "End of the growth axis"};
const bendWords = (i) => `Bend ${i + 1} of the growth axis`;
const focusOn = (words) => document.querySelector(`[data-handle="${words}"]`)?.focus();

// ---- what is drawn over the picture ------------------------------------------------------------------------------

export function drawOver() {
  const over = $("over");
  if (!over || !state.clip) return;
  // Keep the focus when redrawing: a frame may arrive while its edge is moved with the keyboard.
  const held = over.contains(document.activeElement) ? document.activeElement.dataset.handle : "";
  over.setAttribute("viewBox", `0 0 ${view.width} ${view.height}`);
  over.replaceChildren();
  const unit = view.width / Math.max($("stage").clientWidth, 1);
  const axis = currentAxis();
  if (axis && !view.source) drawAxis(over, axis, unit);
  if (placingMarks()) drawMarks(over, unit);
  if (view.edge && !view.source) {
    const {line, middle, put} = view.edge;
    over.append(el("line", {...line, class: "edge-line", "stroke-width": 2 * unit}), knob(8 * unit, unit, true, "Leading edge in this frame", middle, put));
  }
  if (held) focusOn(held);
}

function drawAxis(over, axis, unit) {
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
  if (chosen("tool") !== "axis") return;
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
  over.addEventListener("lostpointercapture", end, {once: true});
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

const marks = {from_px: null, to_px: null};
let [board, ruler, lastAxis] = [null, null, null];

export function readCalibration() {
  const given = state.calibration ?? {kind: "two_points"};
  const kind = given.squares ? "board" : given.kind;
  document.querySelector(`input[name=scale][value=${kind}]`).checked = true;
  if (given.from_px) Object.assign(marks, {from_px: given.from_px, to_px: given.to_px});
  if (given.squares) board = given;
  for (const [id, key] of [["length", "length_mm"], ["own-scale", "mm_per_px"], ["square", "square_mm"], ["marker", "marker_mm"]]) $(id).value = given[key] ?? "";
}

function place(event) {
  const end = Object.keys(MARKS).find((key) => !marks[key]);
  if (!placingMarks() || !end) return;
  setMark(end, at(event));
  // Pressing moves the focus to the pressed element.
  if (marks.to_px) addEventListener("pointerup", () => setTimeout(() => $("length").focus()), {once: true});
}

const MARKS = {from_px: "First ruler mark", to_px: "Second ruler mark"};

function setMark(end, point) {
  marks[end] = rounded(point);
  ruler = null;
  writeScale();
}

function drawMarks(over, unit) {
  const [from, to] = [marks.from_px, marks.to_px];
  // A dot on every mark that was counted
  const dots = ruler && {pathLength: ruler.spacings, "stroke-dasharray": "0 1", "stroke-linecap": "round"};
  if (from && to) over.append(el("line", {class: "ruler-line", x1: from[0], y1: from[1], x2: to[0], y2: to[1], "stroke-width": (ruler ? 3 : 1.5) * unit, ...dots}));
  for (const [end, words] of Object.entries(MARKS)) {
    if (!marks[end]) continue;
    const [x, y] = marks[end];
    const r = 9 * unit;
    const d = `M${x - r} ${y}H${x + r}M${x} ${y - r}V${y + r}M${x - r * 0.6} ${y}a${r * 0.6} ${r * 0.6} 0 1 0 ${r * 1.2} 0a${r * 0.6} ${r * 0.6} 0 1 0 ${-r * 1.2} 0`;
    over.append(handle("path", {class: "mark", "stroke-width": 1.6 * unit, d}, words, () => marks[end], (point) => setMark(end, point)));
  }
}

function writeScale() {
  const amount = (id) => numberOf($(id).value);
  const [length_mm, mm_per_px, square_mm, marker_mm] = [round(amount("length") * $("length-unit").value, 4), amount("own-scale"), amount("square"), amount("marker")];
  const {marker_share, ...printed} = board ?? {};
  state.calibration = {
    two_points: () => (marks.from_px && marks.to_px && length_mm > 0 ? {kind: "two_points", ...marks, length_mm} : null),
    mm_per_px: () => (mm_per_px > 0 ? {kind: "mm_per_px", mm_per_px} : null),
    board: () => (board && square_mm > 0 && (!board.dictionary || marker_mm > 0) ? {...printed, square_mm, ...(board.dictionary ? {marker_mm} : {})} : null),
  }[chosen("scale")]();
  changed();
  redraw();
}

async function findTarget() {
  const picture = view.source || row().video;
  $("target").replaceChildren(el("span", {class: "busy"}, "looking …"));
  try {
    const found = await ask(url("api/target", {picture}));
    $("target").textContent = found ? "" : `No row of marks, 3 px apart or more, and no printed board found in ${picture}: click two marks.`;
    if (!found) return;
    document.querySelector(`input[name=scale][value=${found.squares ? "board" : "two_points"}]`).checked = true;
    if (found.squares) board = found;
    else Object.assign(marks, {from_px: rounded(found.from_px), to_px: rounded(found.to_px)});
    ruler = found.squares ? null : found;
    suggest();
    writeScale();
  } catch (error) {
    $("target").textContent = error.message;
  }
}

// What follows from the size of a square, and from that of a spacing
function suggest() {
  const [square, spacing] = ["square", "spacing"].map((id) => numberOf($(id).value));
  if (square && board?.marker_share) $("marker").value = round(square * board.marker_share, 1);
  if (spacing && ruler) $("length").value = round(spacing * ruler.spacings, 4);
}

// ---- words below the picture -------------------------------------------------------------------------------------

export function drawTools() {
  if (!state.clip) return;
  const axis = currentAxis(), {clip} = state;
  const from = {
    "": axis ? "Found from the motion of this recording. Nothing is written: the axis of each recording is found separately. Drag an end if it is wrong." : `No axis found: ${clip.no_axis}.`,
    all: "Given for all trials, in experiment.yaml.", trial: `Given for ${row().trial} alone, in its row.`,
  };
  $("axis-from").textContent = from[axis?.given ?? ""];
  const turned = axis && !row().growth_angle_deg && !sharedValue("growth_angle_deg") ? Math.abs(Math.atan2(axis.to_px[0] - axis.from_px[0], axis.to_px[1] - axis.from_px[1])) * 180 / Math.PI : 0;
  $("turned-words").textContent = `In the picture growth runs ${turned < 135 ? "level" : "upwards"}. How did the vine grow?`;
  $("axis-ends").textContent = axis ? `${[axis.from_px, axis.to_px].map((end) => rounded(end).join(", ")).join(" to ")} px` : "";
  if (axis) lastAxis = {from_px: axis.from_px, to_px: axis.to_px};
  if (axis?.given) $("axis-scope").value = axis.given;
  const moved = Object.values(state.corrections).flat().filter((one) => one.action === "move").length;
  $("moved-points").textContent = moved ? `${moved === 1 ? "A moved point refers" : `${moved} moved points refer`} to the former axis: after a change of the axis, move them again.` : "";
  const shown = {turned: turned > 45, "draw-axis": !axis, "add-bend": axis, straighten: axis?.via_px?.length, "clear-axis": axis?.given, again: marks.from_px, one: ruler, "board-sizes": board, "marker-size": board?.dictionary};
  for (const [id, wanted] of Object.entries(shown)) $(id).hidden = !wanted;
  $("marks-step").textContent = !marks.from_px ? "Click the first mark of a ruler that lies in the plane of growth." : !marks.to_px ? "Click the second mark, as far away as the ruler allows." : ruler ? `A dot lies on each of ${ruler.spacings + 1} marks found: how far is it from one to the next?` : "Drag a mark, or move it with the arrow keys.";
  if (ruler && Math.abs(ruler.uneven) > 0.02) $("marks-step").textContent += ` The last spacing is ${round(100 * ruler.uneven)} % longer than the first: the ruler was not square to the camera.`;
  if (board) $("board").textContent = `${board.dictionary ? "ChArUco board" : "Checkerboard"}, ${board.squares.join(" × ")} squares${board.dictionary ? ` of ${board.dictionary}` : ""} in ${board.image}`;
  const apart = marks.to_px ? Math.hypot(marks.to_px[0] - marks.from_px[0], marks.to_px[1] - marks.from_px[1]) : null;
  const {mm_per_px, length_mm} = state.calibration ?? {}, scale = length_mm ? length_mm / apart : mm_per_px, words = [];
  if (placingMarks() && apart) words.push(`${decimals(apart, 4)} px apart`);
  if (scale) words.push(`${decimals(scale, 4)} mm a pixel`, `the picture is ${decimals(scale * clip.width, 3)} mm wide`);
  if (view.source && (view.width !== clip.width || view.height !== clip.height)) {
    words.push(`this picture is ${view.width} × ${view.height} px, the recording ${clip.width} × ${clip.height}: take it with the camera's settings of the trials`);
  }
  $("scale-facts").textContent = words.join("; ");
  drawProblems();
}

export function drawProblems() {
  for (const [tool, field] of [["axis-tool", "axis"], ["scale-tool", "calibration"]]) {
    const found = state.problems.filter((problem) => problem.field === field || (problem.field === "cell" && problem.column === field && problem.trial === row()?.trial));
    $(tool).querySelector(".problems").replaceChildren(...listed(found));
  }
}

$("frame").oninput = (event) => showFrame(Number(event.target.value));
$("source").onchange = (event) => showPicture(event.target.value);
$("tools").oninput = () => (chosen("tool") === "scale" && !view.source && state.pictures.length ? showPicture(state.pictures[0]) : redraw());
$("turned").onclick = ({target}) => {
  if (!target.value) return;
  state.shared.growth_angle_deg = target.value;
  [changed, drawTable, redraw].forEach((next) => next());
  $("trials").querySelector("[data-column=growth_angle_deg]").focus();
};
$("axis-scope").onchange = (event) => { if (currentAxis()?.given) setAxis(currentAxis(), event.target.value); };
$("square").oninput = $("spacing").oninput = suggest; // before the scale is written
$("scale-tool").oninput = writeScale;
const clearAxis = () => { if (row().axis) row().axis = ""; else state.axis = null; changed(); redraw(); };
// Where none is found: that of the recording looked at before, or level
const drawAcross = () => setAxis(lastAxis ?? {from_px: [0.1 * state.clip.width, state.clip.height / 2], to_px: [0.9 * state.clip.width, state.clip.height / 2]}, $("axis-scope").value);
const again = () => { Object.assign(marks, {from_px: null, to_px: null}); ruler = null; writeScale(); };
const clicks = {"draw-axis": drawAcross, "add-bend": addBend, straighten: () => changeAxis({via_px: []}), "clear-axis": clearAxis, again, "find-target": findTarget};
for (const [id, act] of Object.entries(clicks)) $(id).onclick = act;
