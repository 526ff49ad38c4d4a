// The motion: strip along the axis with the tracked edge, position against time, and the measured pressure.
import {$, ask, changed, content, decimals, el, listed, round, state} from "./state.js";
import {placesOf, row, showFrame, shownFrame} from "./picture.js";

let last = null;

export function forget() {
  last = null;
  $("tracked").replaceChildren(el("p", {class: "hint"}, "Shows the strip along the axis with the leading edge, before anything is saved."));
}

export async function track() {
  const chosen = state.chosen;
  const name = row().trial;
  $("track").disabled = true;
  $("tracked").replaceChildren(el("p", {class: "busy"}, `Tracking ${name} …`));
  const begun = performance.now();
  try {
    const made = await ask("api/track", content({row: chosen}));
    if (state.chosen === chosen) show({...made, name, seconds: (performance.now() - begun) / 1000});
  } catch (error) {
    const problems = error.content?.problems ?? [{severity: "error", text: error.message}];
    if (state.chosen === chosen) $("tracked").replaceChildren(el("ul", {class: "problems"}, ...listed(problems)));
  }
  $("track").disabled = false;
}

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
  $("tracked").replaceChildren(el("p", {class: "fact"}, el("b", {}, made.name), `: ${facts.join("; ")}.`), strip(made), plot(made), el("p", {class: "readout", id: "readout"}, "Point at the strip or the curve to see the frame."), proofs(),
    el("ul", {class: "problems"}, ...listed(notes.map((text) => ({severity: "note", text})))));
}

// A line through points, broken where there is none.
function lineThrough(xs, ys) {
  const place = (x, i) => (ys[i] === null ? "" : `${(ys[i - 1] ?? null) === null ? "M" : "L"}${x.toFixed(2)} ${ys[i].toFixed(2)}`);
  return xs.map(place).join("");
}

const USABLE = /lost|rejected|duplicate|after_end|doubtful/;

function strip(made) {
  const n = made.edge_px.length;
  const height = made.length_px;
  const over = el("svg", {viewBox: `0 0 ${n} ${height}`, preserveAspectRatio: "none", role: "img", "aria-label": "Strip along the growth axis, time to the right, growth upwards, with the leading edge"});
  const [xs, ys] = [made.edge_px.map((_, i) => i + 0.5), made.edge_px.map((edge) => (edge === null ? null : height - edge))];
  const byHand = (i) => made.flag[i].includes("corrected");
  const dots = (wanted) => ys.map((y, i) => (y !== null && wanted(i) ? `M${xs[i]} ${y.toFixed(2)}h0` : "")).join("");
  over.append(el("path", {class: "edge", d: lineThrough(xs, ys)}),
    el("path", {class: "flagged", d: dots((i) => !byHand(i) && USABLE.test(made.flag[i]))}), el("path", {class: "by-hand", d: dots(byHand)}));
  over.addEventListener("pointermove", (event) => { const box = over.getBoundingClientRect(); point(Math.floor(((event.clientX - box.left) / box.width) * n)); });
  return el("div", {class: "strip"}, el("img", {src: made.strip, alt: ""}), over);
}

function ticks(low, high, count) {
  const rough = (high - low) / count || 1;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((part) => part * power).find((size) => size >= rough);
  const out = [];
  for (let value = Math.ceil(low / step) * step; value <= high + 1e-9 * step; value += step) out.push(Number(value.toPrecision(10)));
  return out;
}

function plot(made) {
  const [W, H, left, right, top, bottom] = [560, 250, 52, made.pressure?.time_s ? 50 : 12, 18, 38];
  const per = made.timed ? 1000 : 1;
  const time = made.time_s.map((value) => value * per);
  const position = made.scaled ? made.position_mm : made.edge_px;
  const known = position.filter((value) => value !== null);
  if (!known.length) return el("p", {class: "hint"}, "There are no positions.");
  const [t0, t1, first] = [Math.min(...time), Math.max(...time), Math.min(...known)];
  const high = Math.max(Math.max(...known) - first, 1e-6) * 1.05;
  const x = (value) => left + ((value - t0) / (t1 - t0 || 1)) * (W - left - right);
  const y = (value) => H - bottom - (value / high) * (H - top - bottom);
  const svg = el("svg", {class: "plot", viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": "Position against time"});
  svg.append(el("path", {class: "frame-line", d: `M${left} ${top}V${H - bottom}H${W - right}`}));
  const tick = (value, x, y, anchor) => svg.append(el("text", {class: "tick", x, y, "text-anchor": anchor}, String(value)));
  for (const value of ticks(t0, t1, 5)) tick(value, x(value), H - bottom + 16, "middle");
  for (const value of ticks(0, high, 4)) tick(value, left - 6, y(value) + 4, "end");
  svg.append(el("text", {x: (left + W - right) / 2, y: H - 4, "text-anchor": "middle"}, made.timed ? "time (ms)" : "frame"), el("text", {x: 4, y: 12}, made.scaled ? "position (mm)" : "position (px)"));
  svg.append(el("path", {class: "curve", d: lineThrough(time.map(x), position.map((value) => (value === null ? null : y(value - first))))}));
  if (made.pressure?.time_s) {
    const kPa = made.pressure.pressure_kPa;
    const top_kPa = Math.max(...kPa, 1e-6) * 1.08;
    const p = (value) => H - bottom - (Math.max(value, 0) / top_kPa) * (H - top - bottom);
    const inside = made.pressure.time_s.map((t, i) => [t * per, kPa[i]]).filter(([t]) => t >= t0 && t <= t1);
    const d = lineThrough(inside.map(([t]) => x(t)), inside.map(([, value]) => p(value)));
    svg.append(el("path", {class: "pressure", d}), el("text", {x: W - 4, y: 12, "text-anchor": "end", class: "p-label"}, "pressure (kPa)"));
    for (const value of ticks(0, top_kPa, 4)) tick(value, W - right + 6, p(value) + 4, "start");
  }
  const cursor = el("path", {class: "cursor", d: ""});
  svg.append(cursor);
  made.cursor = (i) => cursor.setAttribute("d", `M${x(time[i])} ${top}V${H - bottom}`);
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const at = t0 + ((((event.clientX - box.left) / box.width) * W - left) / (W - left - right)) * (t1 - t0);
    point(time.reduce((best, t, i) => (Math.abs(t - at) < Math.abs(time[best] - at) ? i : best), 0));
  });
  return svg;
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

const SETTLED = ["doubtful", "lost", "rejected", "after_end"];

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
  const {name} = made;
  const others = (state.corrections[name] ?? []).filter((one) => one.frame !== i);
  made.first ??= {flag: [...made.flag], edge_px: [...made.edge_px], position_mm: [...made.position_mm]};
  const flags = made.first.flag[i].split(";").filter((flag) => flag && flag !== "corrected");
  if (action !== "undo") others.push({frame: i, action, edge_px: edge});
  made.edge_px[i] = action === "move" ? edge : action === "drop" ? null : made.tracked_px[i];
  const settled = [...flags.filter((flag) => !SETTLED.includes(flag)), ...(action === "drop" ? ["rejected"] : []), "corrected"];
  made.flag[i] = (action === "undo" ? flags : settled).join(";");
  // Approximate, with a constant scale, until it is tracked again.
  const known = made.first.edge_px.findIndex((value, j) => value !== null && made.first.position_mm[j] !== null);
  const from_known = made.mm_per_px * (made.edge_px[i] - made.first.edge_px[known]);
  made.position_mm[i] = made.edge_px[i] === null || !made.mm_per_px || known < 0 ? null : made.first.position_mm[known] + from_known;
  state.corrections[name] = others;
  if (!others.length) delete state.corrections[name];
  changed();
  document.querySelector(".strip").replaceWith(strip(made));
  document.querySelector(".plot")?.replaceWith(plot(made));
  point(i);
}

addEventListener("keydown", (event) => {
  if (!last || event.target.matches("input, select, textarea") || event.ctrlKey || event.metaKey || event.altKey) return;
  const action = {c: "confirm", d: "drop", u: "undo"}[event.key];
  if (action) { event.preventDefault(); correct(shownFrame(), action); }
  if (event.key === "," || event.key === ".") point(shownFrame() + (event.key === "." ? 1 : -1));
});
