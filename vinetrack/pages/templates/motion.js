// The motion: strip along the axis with the tracked edge, position against time, and the measured pressure.
import {$, ask, changed, content, decimals, el, listed, listeners, round, state} from "./state.js";
import {placesOf, row, showFrame, shownFrame} from "./picture.js";

let [last, turn, corrected] = [null, 0, false];

export function forget() {
  [last, turn, corrected] = [null, turn + 1, false];
  $("tracked").replaceChildren(el("p", {class: "hint"}, "Shows the strip along the axis with the leading edge, before anything is saved."));
}

// Again for what was corrected: what is shown stays until the answer is there.
export async function track(again = false) {
  const mine = ++turn;
  const name = row().trial;
  corrected = false;
  $("track").disabled = true;
  if (!again) $("tracked").replaceChildren(el("p", {class: "busy"}, `Tracking ${name} …`));
  const begun = performance.now();
  try {
    const made = await ask("api/track", content({row: state.chosen}));
    if (mine === turn) show({...made, name, seconds: (performance.now() - begun) / 1000});
    if (mine === turn && again) point(shownFrame());
  } catch (error) {
    const problems = error.content?.problems ?? [{severity: "error", text: error.message}];
    if (mine === turn) $("tracked").replaceChildren(el("ul", {class: "problems"}, ...listed(problems)));
  }
  $("track").disabled = false;
}

listeners.push(() => { if (corrected) track(true); });

function show(made) {
  last = made;
  const known = made.edge_px.filter((value) => value !== null).length;
  const facts = [`edge known in ${known} of ${made.edge_px.length} frames`];
  if (made.scaled) facts.push(`growth ${decimals(made.growth_mm, 4)} mm`, `tube ${decimals(made.tube_width_mm, 3)} mm wide`);
  facts.push(`tracked in ${made.seconds.toFixed(1)} s`);
  const notes = [...made.notes];
  if (!made.timed) notes.unshift("Times are in frames: fill in capture_fps.");
  if (!made.scaled) notes.unshift("Positions are in pixels: give a scale.");
  if (made.pressure?.words) notes.unshift(`pressure_trace ${made.pressure.words}`);
  const held = document.activeElement?.id;
  $("tracked").replaceChildren(el("p", {class: "fact"}, el("b", {}, made.name), `: ${facts.join("; ")}.`), strip(made),
    el("p", {class: "readout", id: "readout"}, "Point at the strip to see the frame."), proofs(),
    el("ul", {class: "problems"}, ...listed(notes.map((text) => ({severity: "note", text})))));
  if (held) $(held)?.focus();
}

// A line through points, broken where there is none.
function lineThrough(xs, ys) {
  const place = (x, i) => (ys[i] === null ? "" : `${(ys[i - 1] ?? null) === null ? "M" : "L"}${x.toFixed(2)} ${ys[i].toFixed(2)}`);
  return xs.map(place).join("");
}

const UNUSABLE = /lost|rejected|duplicate|after_end|doubtful/;

// A column of the strip is a frame: time runs to the right, growth upwards.
function strip(made) {
  const [W, H, left, right, top, bottom] = [560, 330, 52, made.pressure?.time_s ? 50 : 12, 18, 38];
  const [width, height, n] = [W - left - right, H - top - bottom, made.edge_px.length];
  const [t0, t1, first] = [made.time_s[0], made.time_s.at(-1), Math.min(...made.edge_px.filter((value) => value !== null), made.length_px)];
  const [per, scale] = [made.timed ? 1000 : 1, made.scaled ? made.mm_per_px : 1];
  const x = (time) => left + ((((time - t0) / (t1 - t0 || 1)) * (n - 1) + 0.5) / n) * width;
  const y = (px) => top + (1 - px / made.length_px) * height;
  const svg = el("svg", {viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": "Strip along the growth axis with the leading edge: position against time"},
    el("image", {href: made.strip, x: left, y: top, width, height, preserveAspectRatio: "none"}));
  const text = (words, x, y, anchor, given = {}) => svg.append(el("text", {x, y, "text-anchor": anchor, ...given}, String(words)));
  const tick = {class: "tick"};
  for (const value of ticks(per * t0, per * t1, 5)) text(value, x(value / per), H - bottom + 16, "middle", tick);
  for (const value of ticks(0, (made.length_px - first) * scale, 4)) text(value, left - 6, y(first + value / scale) + 4, "end", tick);
  text(made.timed ? "time (ms)" : "frame", left + width / 2, H - 4, "middle");
  text(made.scaled ? "position (mm)" : "position (px)", 4, 12, "start");
  const [xs, ys] = [made.time_s.map(x), made.edge_px.map((edge) => (edge === null ? null : y(edge)))];
  const byHand = (i) => made.flag[i].includes("corrected");
  const dots = (wanted) => ys.map((y, i) => (y !== null && wanted(i) ? `M${xs[i]} ${y.toFixed(2)}h0` : "")).join("");
  svg.append(el("path", {class: "edge", d: lineThrough(xs, ys)}),
    el("path", {class: "flagged", d: dots((i) => !byHand(i) && UNUSABLE.test(made.flag[i]))}), el("path", {class: "by-hand", d: dots(byHand)}));
  if (made.pressure?.time_s) {
    const kPa = made.pressure.pressure_kPa;
    const top_kPa = Math.max(...kPa, 1e-6) * 1.08;
    const p = (value) => top + (1 - Math.max(value, 0) / top_kPa) * height;
    const inside = made.pressure.time_s.map((t, i) => [t, kPa[i]]).filter(([t]) => t >= t0 && t <= t1);
    svg.append(el("path", {class: "pressure", d: lineThrough(inside.map(([t]) => x(t)), inside.map(([, value]) => p(value)))}));
    text("pressure (kPa)", W - 4, 12, "end");
    for (const value of ticks(0, top_kPa, 4)) text(value, W - right + 6, p(value) + 4, "start", tick);
  }
  const cursor = el("path", {class: "cursor", d: ""});
  svg.append(cursor);
  made.cursor = (i) => cursor.setAttribute("d", `M${xs[i]} ${top}V${H - bottom}`);
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    point(Math.floor((((event.clientX - box.left) / box.width) * W - left) / width * n));
  });
  return el("div", {class: "strip"}, svg);
}

function ticks(low, high, count) {
  const rough = (high - low) / count || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((part) => part * power).find((size) => size >= rough);
  const out = [];
  for (let value = Math.ceil(low / step) * step; value <= high + 1e-9 * step; value += step) out.push(Number(value.toPrecision(10)));
  return out;
}

let pending = 0;
function point(i) {
  const made = last;
  if (!made || i < 0 || i >= made.edge_px.length) return;
  made.cursor?.(i);
  const words = [`frame ${i}`, made.timed ? `${decimals(1000 * made.time_s[i], 5)} ms` : ""];
  if (made.edge_px[i] !== null) words.push(`edge at ${decimals(made.edge_px[i], 5)} px`, made.scaled ? `${decimals(made.position_mm[i], 5)} mm` : "");
  if (made.flag[i]) words.push(made.flag[i].replaceAll(";", ", ").replaceAll("_", " "));
  $("readout").textContent = words.filter(Boolean).join("; ");
  cancelAnimationFrame(pending);
  pending = requestAnimationFrame(() => showFrame(i, edgeAt(i)));
}

// The edge of a frame in the picture, and how it is moved.
function edgeAt(i) {
  const made = last;
  if (!made) return null;
  const places = placesOf(made.axis);
  const step = made.length_px / (places.length - 1);
  const half = 0.75 * (made.axis.width_px || 0.1 * made.length_px);
  const shake = made.shake_px[i] ?? 0;
  // For a frame without an edge, propose the position of the nearest that has one.
  const nearest = made.edge_px.reduce((best, edge, j) => (edge !== null && Math.abs(j - i) < Math.abs(best - i) ? j : best), Infinity);
  if (nearest === Infinity) return null;
  const edge = made.edge_px[nearest];
  const s = edge + shake;
  const part = Math.max(0, Math.min(places.length - 2, Math.floor(s / step)));
  const [mx, my, ux, uy] = along(places, part, step, s - part * step);
  return {
    line: {x1: mx - half * uy, y1: my + half * ux, x2: mx + half * uy, y2: my - half * ux}, middle: () => [mx, my],
    put: (point) => correct(i, "move", round(nearestAlong(places, step, point) - shake, 2)),
  };
}

// Position and direction `by` px along one segment of an axis, extended straight beyond its ends.
function along(places, part, step, by) {
  const [[x0, y0], [x1, y1]] = [places[part], places[part + 1]];
  const [ux, uy] = [(x1 - x0) / step, (y1 - y0) / step];
  return [x0 + by * ux, y0 + by * uy, ux, uy];
}

function nearestAlong(places, step, [x, y]) {
  let [best, least] = [0, Infinity];
  for (let part = 0; part < places.length - 1; part += 1) {
    const [x0, y0, ux, uy] = along(places, part, step, 0);
    const low = part === 0 ? -Infinity : 0;
    const high = part === places.length - 2 ? Infinity : step;
    const by = Math.max(low, Math.min(high, (x - x0) * ux + (y - y0) * uy));
    const away = Math.hypot(x0 + by * ux - x, y0 + by * uy - y);
    if (away < least) [best, least] = [part * step + by, away];
  }
  return best;
}

// ---- corrections -------------------------------------------------------------------------------------------------

function proofs() {
  const act = (id, words) => el("button", {type: "button", id, onclick: () => correct(shownFrame(), id)}, words);
  const step = (by, name, words) => el("button", {type: "button", "aria-label": name, onclick: () => point(shownFrame() + by)}, words);
  return el("div", {class: "row", id: "proofs", role: "group", "aria-label": "Correct the frame that is shown"},
    el("span", {class: "muted"}, "This frame:"), act("confirm", "Confirm"), act("drop", "Drop"), act("undo", "As tracked"),
    step(-1, "Previous frame", "◀"), step(1, "Next frame", "▶"), el("span", {class: "muted"}, "or drag its edge in the picture"));
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
  document.querySelector(".strip").replaceWith(strip(made));
  point(i);
}

addEventListener("keydown", (event) => {
  if (!last || event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
  const action = {c: "confirm", d: "drop", u: "undo"}[event.key];
  if (action) { event.preventDefault(); correct(shownFrame(), action); }
  if (event.key === "," || event.key === ".") point(shownFrame() + (event.key === "." ? 1 : -1));
});
