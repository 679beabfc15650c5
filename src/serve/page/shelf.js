// The dialogue of the library: its trials, their names when left out, and edits that can be undone.

import { $, ask, button, dated, fill, hide, make, many, percent, printable, say, times } from "./dom.js";
import { go, opened, route } from "./route.js";

const dialog = $("shelf");
let listed = { trials: [], removed: [], undo: null };
let check = { state: "none", report: null };

const share = (value) => (value === null ? "" : percent(value));

async function load() {
  const [trials, audit] = [await ask("library/trials"), await ask("check")];
  if (trials) listed = trials;
  if (audit) check = audit;
  render();
}

async function begin() {
  const view = await ask("check", {});
  if (view) check = { ...check, state: "running" };
  render();
}

// Makes an edit, and repeats the check if one was made before.
async function edit(what, body) {
  const step = await ask(`library/${what}`, body);
  if (!step) return;
  await load();
  if (check.report) begin();
}

// The results of the check, by trial.
function found() {
  const key = ({ surface, user, number, session }) => [surface, user, number, session].join("\n");
  const by = new Map((check.report?.each ?? []).map((trial) => [key(trial), trial]));
  return (trial) => by.get(key(trial)) ?? null;
}

function verdict(of) {
  const cell = make("td");
  if (!of) return cell;
  if (of.verdict === "untested") cell.append(make("span", "only one", "soft"));
  else {
    // The similarity of the first surface divided by the similarity of the second.
    const by = times(Math.exp(of.margin));
    const wrong = of.verdict !== "right";
    cell.append(make("span", wrong ? `wrong: ${of.named ?? "not named"}, by ${by}` : `right, by ${by}`, wrong ? "wrong" : undefined));
  }
  if (of.mislabelled) cell.append(make("span", "mislabelled?", "badge"));
  return cell;
}

function quality(trial, of) {
  const cell = make("td", `${trial.seconds.toFixed(1)} s`);
  for (const flaw of of?.flaws ?? []) cell.append(make("span", flaw, "badge"));
  return cell;
}

function row(trial, of) {
  const line = make("tr");
  line.dataset.trial = trial.trial;
  const act = make("td", undefined, "acts administrator");
  const move = button("Move …", () => startMove(trial.trial));
  const remove = button("Remove", () => edit("remove", { trials: [trial.trial] }));
  move.setAttribute("aria-label", `move ${trial.trial} to another surface`);
  remove.setAttribute("aria-label", `remove ${trial.trial}`);
  act.append(move, remove);
  const began = Date.parse(trial.started_at ?? "");
  const date = Number.isNaN(began) ? "" : dated(began);
  line.append(make("th", `${trial.user}, ${trial.number}`), make("td", date), quality(trial, of), verdict(of), act);
  return line;
}

// A table with a surface and its trials.
function group(surface, trials, of) {
  const body = make("tbody");
  const head = make("tr", undefined, "group");
  const name = make("th", surface);
  name.colSpan = 4;
  const act = make("td", undefined, "acts administrator");
  const rename = button("Rename …", () => startRename(surface));
  rename.setAttribute("aria-label", `rename ${surface}`);
  act.append(rename);
  head.append(name, act);
  body.append(head, ...trials.map((trial) => row(trial, of(trial))));
  return body;
}

function matrix({ labels, counts }) {
  const table = make("table", undefined, "matrix");
  table.append(make("caption", "Rows: what it was. Columns: what it was named, in the same order."));
  const head = make("tr");
  head.append(make("th", ""), ...labels.map((label, i) => {
    const cell = make("th", i + 1);
    cell.title = printable(label);
    return cell;
  }));
  table.append(head);
  labels.forEach((label, truth) => {
    const line = make("tr");
    line.append(make("th", `${truth + 1} ${label}`));
    const all = counts[truth].reduce((sum, count) => sum + count, 0);
    counts[truth].forEach((count, answer) => {
      const cell = make("td", count || "");
      if (count) cell.className = truth === answer ? "hit" : "miss";
      cell.title = printable(`${label}: ${count} of ${all} named ${labels[answer]}`);
      line.append(cell);
    });
    table.append(line);
  });
  return table;
}

function lines(title, texts) {
  const box = make("section");
  box.append(make("h3", title));
  const list = make("ul", undefined, "lines");
  list.append(...texts.map((text) => make("li", text)));
  box.append(list);
  return box;
}

function report(found) {
  const parts = [];
  if (found.accuracy !== null) {
    const range = `${share(found.accuracy_low)} to ${share(found.accuracy_high)}`;
    parts.push(make("p", `Cross-validated accuracy: ${share(found.accuracy)} of ${many(found.surfaces.reduce((n, s) => n + s.queries, 0), "trial")} (95 % interval ${range}).`));
  }
  if (found.mend.length) parts.push(lines("Needs fixing", found.mend));
  if (found.advice.length) parts.push(lines("Next", found.advice));
  if (found.confusion) {
    const details = make("details");
    const box = make("div", undefined, "scroll");
    box.append(matrix(found.confusion));
    details.append(make("summary", "Confusions"), box);
    parts.push(details);
  }
  return parts;
}

function gone(trial) {
  const item = make("li", `${trial.surface}, ${trial.user}, ${trial.number} `);
  const back = button("Restore", () => edit("restore", { trials: [trial.trial] }), "administrator");
  back.setAttribute("aria-label", `restore ${trial.trial}`);
  item.append(back);
  return item;
}

function render() {
  if (!dialog.open) return;
  const of = found();
  const surfaces = Map.groupBy(listed.trials, (trial) => trial.surface);
  const held = document.activeElement?.closest("#shelf-trials tr")?.dataset.trial;
  $("trials-table").replaceChildren($("trials-table").tHead, ...[...surfaces].map(([surface, trials]) => group(surface, trials, of)));
  if (held) document.querySelector(`#shelf-trials tr[data-trial="${CSS.escape(held)}"] button`)?.focus();
  say("shelf-about", `${many(listed.trials.length, "trial")} of ${many(surfaces.size, "surface")}`);
  hide("undo", !listed.undo);
  if (listed.undo) say("undo", `Undo: ${listed.undo.what}`);
  const running = check.state === "running";
  $("check").disabled = running;
  say("check", running ? "Checking …" : check.report ? "Check again" : "Check the library");
  say("check-state", running ? "Each trial is left out and named; that takes a while." : check.problem ?? "");
  $("check-report").replaceChildren(...(check.report ? report(check.report) : []));
  hide("removed-box", listed.removed.length === 0);
  fill("removed", []);
  $("removed").replaceChildren(...listed.removed.map(gone));
  dialog.dataset.check = check.state;
}

// The function that receives the label entered in the small form.
let relabel = null;

function startForm(title, act) {
  relabel = act;
  say("relabel-what", title);
  hide("relabel", false);
  $("relabel-to").value = "";
  $("relabel-to").focus();
}

function startMove(trial) {
  startForm(`Move ${trial} to`, (to) => edit("move", { trials: [trial], to }));
}

function startRename(surface) {
  startForm(`Rename ${surface} to`, (to) => edit("rename", { surface, to }));
}

$("relabel").addEventListener("submit", async (event) => {
  event.preventDefault();
  hide("relabel", true);
  await relabel?.($("relabel-to").value);
});
$("relabel-cancel").addEventListener("click", () => hide("relabel", true));
$("shelf-open").addEventListener("click", () => go("library"));
route("library", dialog, () => {
  opened(dialog);
  load();
});
dialog.addEventListener("close", () => hide("relabel", true));
$("shelf-close").addEventListener("click", () => dialog.close());
$("undo").addEventListener("click", () => edit("undo", {}));
$("check").addEventListener("click", begin);

// Handles the end of a check, or a new reading of the library.
export function checked(view) {
  check = view;
  render();
}

export function changed() {
  if (dialog.open) load();
}
