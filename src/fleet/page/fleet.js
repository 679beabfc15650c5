// The page of a fleet: the state of all stations, requested every second.

import { $, clock, dated, fill, hide, make, many, percent, printable, say, zone } from "./dom.js";
import { heard, isLost, lostText, now, watch } from "./link.js";

const EVERY_MS = 1000;
// A request that takes longer is given up, so that the next one is tried.
const ANSWER_WITHIN_MS = 2000;
const DOWN = ["absent", "stalled", "lost"];
let stations = [];
let stale_after_s = 0;

// The name of an answer, in plain words.
const nameOf = ({ state, surface }) => (state === "unknown" ? "unknown" : surface ?? "not named");

// The problems of a station that a person should fix, a line each.
function troubles(station) {
  const lines = [];
  const down = (station.devices ?? []).filter(({ state }) => DOWN.includes(state));
  if (station.state === "online") for (const { device, state } of down) lines.push(`${device}: ${state}`);
  if (station.review > 0) lines.push(`${many(station.review, "scan")} to review`);
  if (station.dropped > 0) lines.push(`${many(station.dropped, "answer")} dropped while the broker was away`);
  if (station.ahead_ms) lines.push(`its clock is ahead by ${many(Math.round(station.ahead_ms / 60000), "minute")}: set it right`);
  if (station.page_problem) lines.push(`history not read: ${station.page_problem}`);
  return lines;
}

function title(station) {
  const heading = make("h3");
  // A station chooses its own address, so only web addresses become links.
  if (/^https?:\/\//.test(station.page ?? "")) {
    const link = make("a", station.station);
    link.href = station.page;
    heading.append(link);
  } else heading.append(printable(station.station));
  const since = station.since_unix_ms ? ` since ${clock(station.since_unix_ms)}` : "";
  if (isLost()) heading.append(make("span", lostText()));
  else heading.append(make("span", `${station.state ?? "not connected"}${station.state === "offline" ? since : ""}`));
  return heading;
}

// The last answer of a station; faded if it is old, or if nothing newer could have been heard.
function lastLine(station, last) {
  const sure = last.confidence === null || last.state === "unknown" ? "" : `${percent(last.confidence)} · `;
  if (isLost() || station.state !== "online" || now() - last.unix_ms > stale_after_s * 1000) {
    return make("p", `last scan, ${dated(last.unix_ms).slice(0, -3)}: ${nameOf(last)}`, "last stale");
  }
  const line = make("p", nameOf(last), "last");
  line.dataset.state = last.state;
  line.append(" ", make("small", `${sure}${clock(last.unix_ms)}`, "soft"));
  return line;
}

function card(station) {
  const item = make("li");
  const lines = troubles(station);
  item.dataset.state = isLost() ? "lost" : station.state === "online" ? (lines.length > 0 ? "trouble" : "online") : "offline";
  item.append(title(station));
  const [last, ...before] = station.answers;
  if (last) {
    item.append(lastLine(station, last), make("p", before.length > 0 ? `before: ${before.map(nameOf).join(", ")}` : "", "before"));
  }
  const unknown = station.unknown_10_min > 0 ? `, ${station.unknown_10_min} unknown` : "";
  item.append(make("p", `${many(station.scans_10_min, "scan")} in 10 min${unknown}`, "facts"));
  if (lines.length > 0) {
    const list = make("ul");
    list.append(...lines.map((line) => make("li", line)));
    item.append(list);
  }
  return item;
}

function sum(name, value, kind) {
  const group = make("div");
  if (kind) group.dataset[kind] = value > 0;
  group.append(make("dt", name), make("dd", value.toLocaleString("en")));
  return group;
}

function show() {
  const online = stations.filter(({ state }) => state === "online");
  const total = (of) => stations.reduce((all, station) => all + (of(station) ?? 0), 0);
  fill("sums", [
    sum("online", online.length),
    sum("offline", stations.length - online.length, "bad"),
    sum("scans in 10 min", total((station) => station.scans_10_min)),
    sum("unknown in 10 min", total((station) => station.unknown_10_min), "warn"),
    sum("devices down", online.reduce((all, station) => all + (station.devices_down ?? 0), 0), "bad"),
    sum("scans to review", total((station) => station.review), "warn"),
  ]);
  const needy = (station) => station.state !== "online" || troubles(station).length > 0;
  const shown = $("trouble-only").checked ? stations.filter(needy) : stations;
  fill("stations", shown.map(card));
  hide("no-stations", stations.length > 0);
}

// The problems of the whole fleet; empty if there is none.
function problemOf({ broker, passed_over: { messages, last }, too_many_stations }) {
  const lines = [];
  if (broker.problem) lines.push(`The broker is not connected: ${broker.problem}. It is tried again.`);
  if (messages > 0) lines.push(`${many(messages, "message")} passed over; the last: ${last}.`);
  if (too_many_stations) lines.push(`More stations publish than the ${stations.length} that are shown.`);
  return lines.join(" ");
}

function showProblem(problem, isConnected) {
  hide("problem", problem === "");
  say("problem", problem);
  $("link").dataset.state = isConnected ? "connected" : "lost";
  say("link", isLost() ? lostText() : isConnected ? "connected" : "disconnected");
}

function showAll(state) {
  heard(state.now_unix_ms);
  ({ stations, stale_after_s } = state);
  showProblem(problemOf(state), !state.broker.problem);
  say("about", `${state.broker.address} · ${many(state.scans, "answer")} kept`);
  say("version", state.version);
  say("zone", zone());
  show();
}

async function load() {
  const began = performance.now();
  const asked = fetch("api/v1/state", { signal: AbortSignal.timeout(ANSWER_WITHIN_MS) });
  const state = await asked.then((answer) => (answer.ok ? answer.json() : null)).catch(() => null);
  try {
    if (state) showAll(state);
  } finally {
    // Whatever one state holds, the next one is asked for.
    setTimeout(load, Math.max(0, EVERY_MS - (performance.now() - began)));
  }
}

$("trouble-only").addEventListener("change", show);
watch((lost) => {
  if (lost) showProblem(`${lostText()}: this page's program does not answer. The page tries again.`, false);
  show();
});
load();
