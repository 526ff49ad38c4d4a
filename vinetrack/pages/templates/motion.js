// The motion: strip along the axis with the tracked edge, position against time, and the measured pressure.
import {$, ask, changed, content, decimals, el, round, state} from "./state.js";
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
    if (state.chosen === chosen) $("tracked").replaceChildren(el("ul", {class: "problems"}, ...(error.content?.problems ?? [{severity: "error", text: error.message}]).map((problem) => el("li", {class: problem.severity}, problem.text))));
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
    el("ul", {class: "problems"}, ...notes.map((text) => el("li", {class: "note"}, text))));
}

const USABLE = /lost|rejected|duplicate|after_end|doubtful/;

function strip(made) {
  const n = made.edge_px.length;
  const height = made.length_px;
  const over = el("svg", {viewBox: `0 0 ${n} ${height}`, preserveAspectRatio: "none", role: "img", "aria-label": "Strip along the growth axis, time to the right, growth upwards, with the leading edge"});
  let path = "";
  let pen = false;
  let odd = "";
  let hand = "";
  made.edge_px.forEach((edge, i) => {
    if (edge === null) { pen = false; return; }
    const place = `${i + 0.5} ${(height - edge).toFixed(2)}`;
    if (made.flag[i].includes("corrected")) hand += `M${place}h0`;
    else if (USABLE.test(made.flag[i])) odd += `M${place}h0`;
    path += `${pen ? "L" : "M"}${place}`;
    pen = true;
  });
  over.append(el("path", {class: "edge", d: path}), el("path", {class: "flagged", d: odd}), el("path", {class: "by-hand", d: hand}));
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

const range = (values) => { const good = values.filter((value) => value !== null); return [Math.min(...good), Math.max(...good)]; };

function plot(made) {
  const [W, H, left, right, top, bottom] = [560, 250, 52, made.pressure?.time_s ? 50 : 12, 18, 38];
  const per = made.timed ? 1000 : 1;
  const time = made.time_s.map((value) => value * per);
  const position = made.scaled ? made.position_mm : made.edge_px;
  if (!position.some((value) => value !== null)) return el("p", {class: "hint"}, "There are no positions.");
  const [t0, t1] = range(time);
  const first = Math.min(...position.filter((value) => value !== null));
  const grown = position.map((value) => (value === null ? null : value - first));
  const high = Math.max(range(grown)[1], 1e-6) * 1.05;
  const x = (value) => left + ((value - t0) / (t1 - t0 || 1)) * (W - left - right);
  const y = (value) => H - bottom - (value / high) * (H - top - bottom);
  const svg = el("svg", {class: "plot", viewBox: `0 0 ${W} ${H}`, role: "img", "aria-label": "Position against time"});
  svg.append(el("path", {class: "frame-line", d: `M${left} ${top}V${H - bottom}H${W - right}`}));
  for (const value of ticks(t0, t1, 5)) svg.append(el("text", {class: "tick", x: x(value), y: H - bottom + 16, "text-anchor": "middle"}, String(value)));
  for (const value of ticks(0, high, 4)) svg.append(el("text", {class: "tick", x: left - 6, y: y(value) + 4, "text-anchor": "end"}, String(value)));
  svg.append(el("text", {x: (left + W - right) / 2, y: H - 4, "text-anchor": "middle"}, made.timed ? "time (ms)" : "frame"), el("text", {x: 4, y: 12}, made.scaled ? "position (mm)" : "position (px)"));
  const line = (ts, values, scale) => { let pen = false; return ts.map((t, i) => { if (values[i] === null) { pen = false; return ""; } const place = `${pen ? "L" : "M"}${x(t).toFixed(1)} ${scale(values[i]).toFixed(1)}`; pen = true; return place; }).join(""); };
  svg.append(el("path", {class: "curve", d: line(time, grown, y)}));
  if (made.pressure?.time_s) {
    const kPa = made.pressure.pressure_kPa;
    const top_kPa = Math.max(...kPa, 1e-6) * 1.08;
    const p = (value) => H - bottom - (Math.max(value, 0) / top_kPa) * (H - top - bottom);
    const inside = made.pressure.time_s.map((t) => t * per);
    const keep = inside.map((t, i) => [t, kPa[i]]).filter(([t]) => t >= t0 && t <= t1);
    svg.append(el("path", {class: "pressure", d: line(keep.map((pair) => pair[0]), keep.map((pair) => pair[1]), p)}), el("text", {x: W - 4, y: 12, "text-anchor": "end", class: "p-label"}, "pressure (kPa)"));
    for (const value of ticks(0, top_kPa, 4)) svg.append(el("text", {class: "tick", x: W - right + 6, y: p(value) + 4}, String(value)));
  }
  const cursor = el("path", {class: "cursor", d: ""});
  svg.append(cursor);
  made.cursor = (i) => cursor.setAttribute("d", `M${x(time[i])} ${top}V${H - bottom}`);
  svg.addEventListener("pointermove", (event) => {
    const box = svg.getBoundingClientRect();
    const at = t0 + ((((event.clientX - box.left) / box.width) * W - left) / (W - left - right)) * (t1 - t0);
    let best = 0;
    time.forEach((t, i) => { if (Math.abs(t - at) < Math.abs(time[best] - at)) best = i; });
    point(best);
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
  // For a frame without an edge, propose the position of its neighbours.
  const edge = made.edge_px[i] ?? nearest(made.edge_px, i);
  if (edge === null) return null;
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

function nearest(values, i) {
  for (let step = 1; step < values.length; step += 1) for (const j of [i - step, i + step]) if (values[j] !== null && values[j] !== undefined) return values[j];
  return null;
}

// ---- corrections -------------------------------------------------------------------------------------------------

const SETTLED = ["doubtful", "lost", "rejected", "after_end", "corrected"];

function proofs() {
  const act = (action) => () => correct(shownFrame(), action);
  return el("div", {class: "row", id: "proofs", role: "group", "aria-label": "Correct the frame that is shown"},
    el("span", {class: "muted"}, "This frame:"), el("button", {type: "button", id: "confirm", onclick: act("confirm")}, "Confirm"),
    el("button", {type: "button", id: "drop", onclick: act("drop")}, "Drop"), el("button", {type: "button", id: "undo", onclick: act("undo")}, "As tracked"),
    el("button", {type: "button", "aria-label": "Previous frame", onclick: () => point(shownFrame() - 1)}, "◀"), el("button", {type: "button", "aria-label": "Next frame", onclick: () => point(shownFrame() + 1)}, "▶"),
    el("span", {class: "muted"}, "or drag its edge in the picture"));
}

function correct(i, action, edge = null) {
  const made = last;
  if (action === "confirm" && made.edge_px[i] === null) { $("readout").textContent = `frame ${i} has no edge to be confirmed: drag it to where the edge is`; return; }
  const {name} = made;
  const others = (state.corrections[name] ?? []).filter((one) => one.frame !== i);
  const mm = made.mm_per_px ?? null;
  made.first_flag ??= [...made.flag];
  made.first_edge ??= [...made.edge_px];
  made.first_mm ??= [...made.position_mm];
  const bare = made.first_flag[i].split(";").filter((flag) => flag && !SETTLED.includes(flag));
  if (action === "undo") {
    made.edge_px[i] = made.tracked_px[i];
    made.flag[i] = made.first_flag[i].split(";").filter((flag) => flag !== "corrected").join(";");
  } else {
    others.push({frame: i, action, edge_px: edge});
    made.edge_px[i] = action === "move" ? edge : action === "drop" ? null : made.tracked_px[i];
    made.flag[i] = [...bare, ...(action === "drop" ? ["rejected"] : []), "corrected"].join(";");
  }
  // Approximate, with a constant scale, until it is tracked again.
  const known = made.first_edge.findIndex((value, j) => value !== null && made.first_mm[j] !== null);
  made.position_mm[i] = made.edge_px[i] === null || mm === null || known < 0 ? null : made.first_mm[known] + mm * (made.edge_px[i] - made.first_edge[known]);
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
