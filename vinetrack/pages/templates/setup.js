// Entry point of the page: load, handle events, check and save.
import {$, ask, content, listed, listeners, problemsOf, settle, state} from "./state.js";
import {drawOver, drawProblems, readCalibration, showRecording} from "./picture.js";
import {drawTable, markProblems} from "./table.js";
import {forget, track} from "./motion.js";

function choose(i) {
  if (i === state.chosen) return;
  state.chosen = i;
  for (const line of $("trials").querySelectorAll("tr[data-row]")) line.classList.toggle("chosen", Number(line.dataset.row) === i);
  forget();
  showRecording();
}

const showWhole = (extra = []) => $("whole").replaceChildren(...listed([...extra, ...state.problems.filter((problem) => problem.field === "whole")]));

function showState() {
  // What several recordings contradict is one thing to correct.
  const things = new Map(state.problems.map((problem) => [problem.of_a_measurement ? problem.column : problem, problem]));
  const errors = [...things.values()].filter((problem) => problem.severity === "error").length;
  const warnings = things.size - errors;
  // Until the recordings were compared only the sheet was checked: whether they agree with it is not known yet.
  const ready = state.compared ? "ready to run" : "complete; Check compares them with the recordings";
  const todo = `${errors} ${errors === 1 ? "thing" : "things"} to fill in or correct`;
  $("headline").textContent = `${state.sheet.rows.length} trials, ${errors ? todo : ready}`;
  const words = [];
  if (warnings) words.push(`${warnings} ${warnings === 1 ? "warning" : "warnings"}`);
  words.push(state.dirty ? "not saved" : "saved as shown");
  if (!errors && !state.dirty) words.push(`next: ${state.next}`);
  $("status").textContent = words.join(" · ");
  $("save").disabled = !state.dirty;
}

let turn = 0;
async function check(thorough = false) {
  const mine = ++turn;
  settle();
  if (thorough) $("status").textContent = "Opening every recording …";
  const found = await ask("api/check", content({thorough})).catch((error) => ({problems: problemsOf(error), texts: {}, notes: [], understood: []}));
  if (mine !== turn) return;
  state.problems = found.problems;
  if (thorough) state.compared = true;
  for (const [name, text] of Object.entries(found.texts)) {
    $(name).textContent = text;
    $(name).parentElement.hidden = !text;
  }
  showWhole([...markProblems(), ...found.notes.map((text) => ({severity: "note", text}))]);
  $("understood").hidden = !found.understood.length;
  $("understood").textContent = found.understood.join("\n");
  showState();
  drawProblems();
}

async function save() {
  try {
    const made = await ask("api/save", content());
    state.stamp = made.stamp;
    state.dirty = false;
    showState(); // saving changes nothing that was checked
    $("status").textContent = `${made.written.length ? `Written: ${made.written.join(", ")}` : "No changes"} · ${$("status").textContent}`;
  } catch (error) {
    showWhole(problemsOf(error));
  }
}

async function begin() {
  try {
    Object.assign(state, await ask("api/state"));
  } catch (error) {
    $("headline").textContent = "This folder cannot be set up yet";
    showWhole(problemsOf(error));
    return;
  }
  state.dirty = state.unsaved;
  $("name").textContent = state.name;
  document.title = `${state.name} – vinetrack set-up`;
  readCalibration();
  drawTable();
  listeners.push(() => check());
  await Promise.all([check(), showRecording()]);
  document.body.dataset.ready = "yes";
}

for (const kind of ["click", "focusin"]) $("trials").addEventListener(kind, ({target}) => { const line = target.closest("tr[data-row]"); if (line) choose(Number(line.dataset.row)); });
$("save").onclick = save;
$("check").onclick = () => check(true);
$("track").onclick = () => track();
addEventListener("keydown", (event) => {
  if ((event.ctrlKey || event.metaKey) && event.key === "s") { event.preventDefault(); save(); }
});
addEventListener("beforeunload", (event) => { if (state.dirty) event.preventDefault(); });
addEventListener("resize", drawOver);
begin();
