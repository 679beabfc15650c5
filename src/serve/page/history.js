// The list of past scans, the newest first, and the share of reviewed answers that were right.

import { corrected, damageOf, isFault, isShort, nameOf, sureness } from "./answer.js";
import { $, ask, button, dated, fill, hide, make, many, percent, printable, say } from "./dom.js";
import { go } from "./route.js";
import * as select from "./select.js";

// How many scans are loaded at a time.
const PAGE = 300;
// How long corrections are waited for before the precision is asked for.
const PRECISION_MS = 500;
let waiting = 0;
let most = PAGE;
let scans = [];
let latest = null;
// Whether there are older scans to load.
let more = false;
let changed = () => {};
let shown = "";

// Sets a function that is called after each change of the list.
export function onChange(act) {
  changed = act;
  select.follow(() => scans, act);
}

// The filter as parameters of a request; empty if it lets all through.
function filter() {
  const of = (id) => $(`filter-${id}`).value.trim();
  const ms = (id) => (of(id) ? String(new Date(of(id)).getTime()) : "");
  // A time without seconds means the whole minute.
  const to = of("to") ? String(new Date(of("to")).getTime() + 59_999) : "";
  const all = { state: of("state"), surface: of("surface"), user: of("user"), from_unix_ms: ms("from"), to_unix_ms: to, text: of("text") };
  return new URLSearchParams(Object.entries(all).filter(([, value]) => value !== "")).toString();
}

// Loads the list again. Answers to earlier requests are dropped.
let loads = 0;
export async function load() {
  loads += 1;
  const [mine, wanted] = [loads, filter()];
  const said = await ask(`scans?limit=${PAGE}&${wanted}`);
  if (mine !== loads) return;
  if (said) [scans, most, more] = [said.scans, PAGE, said.scans.length === PAGE];
  if (said && wanted === "") latest = scans[0] ?? null;
  say("export-of", wanted === "" ? "All scans" : "These scans");
  for (const [id, file] of [["export-csv", "scans.csv"], ["export-lines", "scans.jsonl"]]) {
    $(id).href = `api/v1/${file}${wanted && `?${wanted}`}`;
  }
  changed();
  offerPeople();
  loadPrecision();
}

const people = new Set();

// Offers the people of the scans that were listed so far; where no scan holds one, there is nobody to ask for.
function offerPeople() {
  scans.forEach((scan) => scan.user && people.add(scan.user));
  hide("of-person", people.size === 0);
  fill("people", [...people].sort().map((person) => Object.assign(make("option"), { value: person })));
}

// Loads scans that are older than the list.
export async function older() {
  const last = scans[scans.length - 1];
  const said = last && (await ask(`scans?limit=${PAGE}&before=${encodeURIComponent(last.id)}&${filter()}`));
  if (!said) return;
  scans = [...scans, ...said.scans];
  [most, more] = [most + PAGE, said.scans.length === PAGE];
  changed();
  offerPeople();
}

// The newest scan; null if there is none.
export const newest = () => latest;

// Handles a new answer, named or not.
export function add(answer) {
  const scan = { ...answer, correction: null, became: null, became_by: null, kept: null };
  latest = scan;
  // Whether the filter lets it through is known to the station alone.
  if (filter() !== "") return void load();
  if (scans.some((other) => other.id === scan.id)) return;
  scans = [scan, ...scans];
  offerPeople();
  if (scans.length > most) [scans, more] = [scans.slice(0, most), true];
}

// Handles a scan that was corrected, or became a trial.
export function change(scan) {
  scans = scans.map((other) => (other.id === scan.id ? scan : other));
  if (latest?.id === scan.id) latest = scan;
  // Many scans may be corrected at once.
  waiting ||= setTimeout(loadPrecision, PRECISION_MS);
}

function badge(text, kind, title) {
  const element = make("span", text, `badge ${kind}`);
  if (title) element.title = printable(title);
  return element;
}

function row(scan) {
  const line = make("tr", undefined, scan.state);
  line.dataset.id = scan.id;
  const name = make("td");
  const open = button(nameOf(scan), () => go(`scan=${scan.id}`), "open");
  open.setAttribute("aria-label", printable(`open scan ${scan.scan}: ${nameOf(scan)}`));
  name.append(open);
  if (scan.state === "unknown" && scan.ranked[0]) name.append(badge(`closest: ${scan.ranked[0].surface}`, ""));
  if (scan.state === "unnamed") name.append(make("small", scan.reasons.join(" · ")));
  const damage = damageOf(scan);
  if (damage.length) name.append(badge(isFault(scan) ? "sensor fault" : "data lost", "bad", damage.join("\n")));
  if (isShort(scan)) name.append(badge("too short", ""));
  if (scan.correction) name.append(badge(corrected(scan), corrected(scan).startsWith("right") ? "good" : ""));
  if (scan.became) name.append(badge("in the library", "good", scan.became));
  const number = make("td", select.isOn() ? undefined : scan.scan);
  if (select.isOn()) number.append(select.box(scan));
  line.append(number, make("td", dated(scan.unix_ms)), name, make("td", sureness(scan)),
    make("td", `${scan.scan_s.toFixed(1)} s`, "wide"), make("td", `${scan.latency_ms.toFixed(0)} ms`, "wide"),
    make("td", scan.lost_samples));
  return line;
}

// Shows the list if it has changed.
export function render(counts) {
  const text = [select.look(), ...scans.map((scan) => [scan.id, scan.became, JSON.stringify(scan.correction)].join())].join();
  if (text !== shown) {
    shown = text;
    const held = document.activeElement?.closest("#scans tr")?.dataset.id;
    const kind = document.activeElement?.matches("input") ? "input" : "button";
    $("scans").replaceChildren(...scans.map(row));
    if (held) document.querySelector(`#scans tr[data-id="${CSS.escape(held)}"] ${kind}`)?.focus();
  }
  select.show();
  hide("no-scans", scans.length > 0);
  say("no-scans", filter() === "" ? "Scans appear here as they are named." : "No scan is like that.");
  hide("older", !more);
  const { scans: count, unknown, unsure, unnamed, damaged } = counts;
  const parts = [many(count, "scan"), `${unknown} unknown`, `${unsure} unsure`];
  if (unnamed) parts.push(`${unnamed} not named`);
  if (damaged) parts.push(`${damaged} with sensor faults or lost data`);
  say("counts", count || unnamed ? parts.join(" · ") : "");
}

function precisionRow({ surface, corrected, right, precision, precision_low, precision_high }) {
  const line = make("tr");
  const name = make("th", surface ?? "unknown");
  name.scope = "row";
  line.append(name, make("td", right), make("td", corrected), make("td", percent(precision)),
    make("td", `${percent(precision_low)} to ${percent(precision_high)}`));
  return line;
}

// Loads how many answers were right. Without corrections, nothing is shown.
async function loadPrecision() {
  clearTimeout(waiting);
  waiting = 0;
  const said = await ask("history");
  if (!said) return;
  const found = said.precision;
  hide("precision-box", found.length === 0);
  const sum = (of) => found.reduce((all, surface) => all + surface[of], 0);
  say("precision-sum", `Corrected answers: ${sum("right")} right of ${sum("corrected")}`);
  $("precision").replaceChildren(...found.map(precisionRow));
}
