// The motion: the strip along the axis with the tracked edge, the frame pointed at, and corrections.
import {$, ask, changed, content, decimals, el, listed, listeners, problemsOf, round, state} from "./state.js";
import {placesOf, row, showFrame, shownFrame} from "./picture.js";

let [last, turn, corrected] = [null, 0, false];

export function forget() {
  [last, turn, corrected] = [null, turn + 1, false];
  $("tracked").replaceChildren();
  $("readout").textContent = "";
  $("proofs").hidden = true;
}

// Again for what was corrected: what is shown stays until the answer is there.
export async function track(again = false) {
  const mine = ++turn;
  const name = row().trial;
  corrected = false;
  $("track").disabled = true;
  if (!again) $("tracked").replaceChildren(el("p", {class: "busy"}, `Tracking ${name} …`));
  try {
    const made = await ask("api/track", content({row: state.chosen}));
    if (mine === turn) show({...made, name});
    if (mine === turn && again) point(shownFrame());
  } catch (error) {
    if (mine === turn) $("tracked").replaceChildren(el("ul", {class: "problems"}, ...listed(problemsOf(error))));
  }
  $("track").disabled = false;
}

listeners.push(() => { if (corrected) track(true); });

function show(made) {
  last = made;
  const count = (values, wanted) => values.filter(wanted).length;
  const facts = [`edge known in ${count(made.edge_px, (edge) => edge !== null)} of ${made.flag.length} frames`];
  const byHand = count(made.flag, (flag) => flag.includes("corrected"));
  if (byHand) facts.push(`${byHand} corrected by hand`);
  if (made.scaled) facts.push(`growth ${decimals(made.growth_mm, 4)} mm`, `tube ${decimals(made.tube_width_mm, 3)} mm wide`);
  const notes = [...made.notes];
  if (!made.timed) notes.unshift("Times are in frames: fill in capture_fps.");
  if (!made.scaled) notes.unshift("Positions are in pixels: give a scale.");
  // Frames run downwards in the figure.
  const [[top, bottom], [from, to]] = [made.frames_at, made.frames];
  const share = ({offsetY, target}) => (offsetY / target.clientHeight - top) / (bottom - top);
  const strip = el("img", {src: made.strip, alt: "Strip along the growth axis with the leading edge: time downwards", onpointermove: (event) => point(from + Math.floor(share(event) * (to - from + 1)))});
  const cursor = el("div", {class: "cursor", hidden: true});
  made.cursor = (i) => { cursor.hidden = false; cursor.style.top = `${100 * (top + (bottom - top) * (i - from + 0.5) / (to - from + 1))}%`; };
  $("tracked").replaceChildren(el("p", {class: "fact"}, el("b", {}, made.name), `: ${facts.join("; ")}.`),
    el("ul", {class: "problems"}, ...listed(notes.map((text) => ({severity: "note", text})))), el("div", {class: "strip"}, strip, cursor));
  $("readout").textContent = "Point at the strip to see the frame.";
  $("proofs").hidden = false;
}

function point(i) {
  const made = last;
  if (!made || i < 0 || i >= made.flag.length) return;
  made.cursor(i);
  const words = [`frame ${i}`, made.timed ? `${decimals(1000 * made.time_s[i], 5)} ms` : ""];
  if (made.edge_px[i] !== null) words.push(`edge at ${decimals(made.edge_px[i], 5)} px`, made.scaled ? `${decimals(made.position_mm[i], 5)} mm` : "");
  if (made.flag[i]) words.push(made.flag[i].replaceAll(";", ", ").replaceAll("_", " "));
  $("readout").textContent = words.filter(Boolean).join("; ");
  showFrame(i, edgeAt(i));
}

// The edge of a frame in the picture, and how it is moved: along the axis where it is, from one event to the next.
function edgeAt(i) {
  const made = last;
  // For a frame without an edge, propose the position of the nearest that has one.
  const nearest = made?.edge_px.reduce((best, edge, j) => (edge !== null && Math.abs(j - i) < Math.abs(best - i) ? j : best), Infinity) ?? Infinity;
  if (nearest === Infinity) return null;
  const here = () => placeAt(made, (made.edge_px[i] ?? made.edge_px[nearest]) + (made.shake_px[i] ?? 0));
  const [x, y, ux, uy] = here();
  const half = 0.75 * (made.axis.width_px || 0.1 * made.length_px);
  const put = (point) => {
    const [x, y, ux, uy, along] = here();
    correct(i, "move", round(along + (point[0] - x) * ux + (point[1] - y) * uy - (made.shake_px[i] ?? 0), 2));
  };
  return {line: {x1: x - half * uy, y1: y + half * ux, x2: x + half * uy, y2: y - half * ux}, middle: () => here().slice(0, 2), put};
}

// Point and direction of the axis at a length along it, and the length; it continues straight beyond its ends.
function placeAt(made, along) {
  const places = placesOf(made.axis), step = made.length_px / (places.length - 1);
  const part = Math.max(0, Math.min(places.length - 2, Math.floor(along / step))), by = along - part * step;
  const [[x0, y0], [x1, y1]] = [places[part], places[part + 1]];
  const [ux, uy] = [(x1 - x0) / step, (y1 - y0) / step];
  return [x0 + by * ux, y0 + by * uy, ux, uy, along];
}

function correct(i, action, edge = null) {
  const made = last;
  if (action === "confirm" && made.edge_px[i] === null) { $("readout").textContent = `frame ${i} has no edge to be confirmed: drag it to where the edge is`; return; }
  const given = (state.corrections[made.name] ?? []).filter((one) => one.frame !== i);
  if (action !== "undo") given.push({frame: i, action, edge_px: edge});
  state.corrections[made.name] = given;
  if (!given.length) delete state.corrections[made.name];
  // Until it was tracked again
  if (action === "move" || action === "drop") made.edge_px[i] = edge;
  made.flag[i] = action === "undo" ? "" : "corrected";
  corrected = true;
  changed();
  point(i);
}

const acts = {previous: () => point(shownFrame() - 1), next: () => point(shownFrame() + 1)};
for (const action of ["confirm", "drop", "undo"]) acts[action] = () => correct(shownFrame(), action);
for (const [id, act] of Object.entries(acts)) $(id).onclick = act;

const KEYS = {c: "confirm", d: "drop", u: "undo", ",": "previous", ".": "next"};
addEventListener("keydown", (event) => {
  if (!last || event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey || !(event.key in KEYS)) return;
  event.preventDefault();
  acts[KEYS[event.key]]();
});
