// Selects past scans, to correct all of them at once, and to undo that as one.

import { $, ask, hide, make, many, say } from "./dom.js";

// How many scans one request may name.
const MOST = 1000;
const picked = new Set();
let on = false;
let looks = 0;
let scans = () => [];
let changed = () => {};
// The corrections that the last one replaced: pairs of an id and its correction before.
let replaced = [];

// Sets the functions that give the scans of the list, and that show the list anew.
export function follow(list, act) {
  [scans, changed] = [list, act];
}

export const isOn = () => on;

// How often all boxes changed at once, so that the list must be shown anew.
export const look = () => looks;

// The scans that are selected; of a list that changed, only those that are still in it.
const chosen = () => scans().filter(({ id }) => picked.has(id));

// The number of a scan with a box to select it.
export function box(scan) {
  const label = make("label", undefined, "pick");
  const input = make("input");
  input.type = "checkbox";
  input.checked = picked.has(scan.id);
  input.setAttribute("aria-label", `select scan ${scan.scan}, ${scan.id}`);
  input.addEventListener("change", () => {
    if (input.checked) picked.add(scan.id);
    else picked.delete(scan.id);
    show();
  });
  label.append(input, String(scan.scan));
  return label;
}

export function show() {
  const count = chosen().length;
  $("select-open").setAttribute("aria-pressed", String(on));
  hide("select-bar", !on);
  say("selected", count ? `${many(count, "scan")} selected` : "Select scans by the boxes before their numbers.");
  for (const id of ["all-unknown", "all-bad", "all-clear", "all-other"]) $(id).disabled = count === 0;
  hide("select-undo", replaced.length === 0);
}

function showAnew() {
  looks += 1;
  changed();
}

// Corrects scans in the same way. Returns the ids that were corrected, and why others were not.
async function correct(ids, was) {
  const [done, problems] = [[], []];
  for (let at = 0; at < ids.length; at += MOST) {
    const said = await ask("scans/correct", { ids: ids.slice(at, at + MOST), ...was });
    if (!said) break;
    for (const { id, error, message } of said.each) {
      if (error === null) done.push(id);
      else problems.push(message);
    }
  }
  return { done, problems };
}

function tell(what, { done, problems }) {
  const first = problems.length ? ` Not done for ${many(problems.length, "scan")}: ${problems[0]}.` : "";
  say("select-done", `${what} ${many(done.length, "scan")}.${first}`);
}

async function correctAll(was) {
  const before = new Map(chosen().map(({ id, correction }) => [id, correction]));
  if (before.size === 0) return;
  const found = await correct([...before.keys()], was);
  replaced = found.done.map((id) => [id, before.get(id)]);
  found.done.forEach((id) => picked.delete(id));
  tell(Object.keys(was).length ? "Corrected" : "Took back the corrections of", found);
  showAnew();
}

// A correction as a request states it.
const request = (correction) => (correction === null ? {}
  : correction.was === "surface" ? { surface: correction.surface } : { [correction.was]: true });

async function undo() {
  const all = { done: [], problems: [] };
  // Nearly always there is one group: scans that had no correction.
  for (const [was, group] of Map.groupBy(replaced, ([, correction]) => JSON.stringify(request(correction)))) {
    const { done, problems } = await correct(group.map(([id]) => id), JSON.parse(was));
    all.done.push(...done);
    all.problems.push(...problems);
  }
  replaced = replaced.filter(([id]) => !all.done.includes(id));
  tell("Undone for", all);
  changed();
  $("select-all").focus();
}

$("select-open").addEventListener("click", () => {
  on = !on;
  picked.clear();
  replaced = [];
  say("select-done", "");
  showAnew();
});
$("select-all").addEventListener("click", () => {
  scans().forEach(({ id }) => picked.add(id));
  showAnew();
});
$("all-unknown").addEventListener("click", () => correctAll({ unknown: true }));
$("all-bad").addEventListener("click", () => correctAll({ bad: true }));
$("all-clear").addEventListener("click", () => correctAll({}));
$("select-undo").addEventListener("click", undo);
$("select-bar").addEventListener("submit", (event) => {
  event.preventDefault();
  correctAll({ surface: $("all-were").value });
});
