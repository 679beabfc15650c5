// The state of the station, readable from three metres: colour, word and sign; below them the name,
// its probability, and any damage.

import { certainty, damageOf, isFault, isShort, nameOf, probabilities } from "./answer.js";
import { $, clock, dated, doubtLines, fill, hide, make, many, parts, percent, printable, say, times } from "./dom.js";
import { lostText, now as time } from "./link.js";

const WORDS = { named: "Named", nearest: "Nearest surface", unsure: "Unsure", unnamed: "No answer" };

function disconnected({ advice, devices }) {
  const since = devices.find(({ device }) => device === advice.device)?.since_unix_ms ?? time();
  const seconds = Math.max(0, Math.round((time() - since) / 1000));
  const lasts = seconds < 60 ? `${seconds} s` : many(Math.floor(seconds / 60), "minute");
  return { kind: "disconnected", word: advice.text, sure: `for ${lasts}, since ${clock(since)}` };
}

// The present surface of what moves without begin and end.
function moving({ scan, guess }, surfaces) {
  const [{ surface, probability }] = guess.named;
  const unknown = guess.state === "unknown";
  const now = { kind: guess.state, word: unknown ? `None of your ${many(surfaces, "surface")}` : WORDS[guess.state] };
  now.label = `scan ${scan}, for ${many(Math.floor(guess.scan_s - guess.since_s), "second")}`;
  if (unknown) return { ...now, name: "unknown", sure: `closest: ${surface}` };
  now.runners = guess.named.map(({ surface, probability }) => [surface, probability, percent(probability)]);
  return { ...now, name: surface, sure: `${percent(probability)} sure` };
}

// A scan in progress: what to do, and the name it would have if it ended now.
function dragging({ advice, scan, guess: last, enrolling, library }) {
  const guess = last?.scan === scan ? last : null;
  if (!enrolling && typeof guess?.since_s === "number") return moving({ scan, guess }, library?.surfaces.length ?? 0);
  const lift = advice.do === "lift";
  const more = advice.more_s === null ? "" : `: ${advice.more_s.toFixed(1)} s more`;
  const now = { kind: lift ? "lift" : "drag", word: lift ? "Done, lift" : `Drag on${more}`, label: `scan ${scan}` };
  if (guess?.needed_s) now.done = guess.scan_s / guess.needed_s;
  now.damage = doubtLines(guess?.damage ?? []);
  if (enrolling) return { ...now, name: enrolling.surface, label: `scan ${scan}, to be kept` };
  if (!guess?.state) return { ...now, name: "listening", faint: true };
  const [{ surface, probability }] = guess.named;
  now.runners = guess.named.map(({ surface, probability }) => [surface, probability, percent(probability)]);
  if (guess.state === "unknown") return { ...now, name: "unknown", sure: `closest: ${surface}`, runners: [] };
  return { ...now, name: surface, sure: `${percent(probability)} sure` };
}

function runners(answer) {
  const shares = probabilities(answer);
  const best = answer.ranked[0]?.score;
  return answer.ranked.map(({ surface, score }, at) => (shares ? [surface, shares[at], percent(shares[at])]
    : [surface, score > 0 ? best / score : 1, score > best ? `${times(score / best)} as far` : "nearest"]));
}

function answered(answer, surfaces) {
  const damage = damageOf(answer);
  const short = isShort(answer) && ["named", "nearest"].includes(answer.state);
  const kind = damage.length && answer.state !== "unnamed" ? "damaged" : short ? "unsure" : answer.state;
  const unknown = answer.state === "unknown";
  const words = {
    ...WORDS, unknown: `None of your ${many(surfaces, "surface")}`, damaged: isFault(answer) ? "Sensor fault" : "Data lost",
  };
  const word = short && kind === "unsure" ? "Too short" : words[kind];
  const name = unknown ? "unknown" : answer.surface ?? "not named";
  const label = `scan ${answer.scan}${answer.synthetic ? " · synthetic" : ""} · answered in ${answer.latency_ms.toFixed(0)} ms`;
  return { kind, word, name, label, damage, sure: certainty(answer), at: `at ${clock(answer.unix_ms)}`, id: answer.id, runners: unknown ? [] : runners(answer) };
}

// An answer that is too old to be read as the present one.
function lastScan(answer) {
  const said = answer.state === "unnamed" ? "not named" : `${nameOf(answer)}, ${certainty(answer)}`;
  return { at: `last scan, ${dated(answer.unix_ms).slice(0, -3)}`, label: `it was scan ${answer.scan}: ${said}`, id: answer.id };
}

function idle({ advice, reading }) {
  const words = { ended: "The station has ended", wait: reading ? "Reading the library" : "Waiting for the devices" };
  const word = words[advice.do] ?? "Ready";
  return { kind: "idle", word, name: word === "Ready" ? "tap, then drag" : "" };
}

// Whether a station has too few surfaces to name any scan.
export function isEmpty({ library, enrolls, enrolling, advice, devices }) {
  const lost = devices.some(({ device, state }) => device === advice.device && state === "lost");
  return enrolls && !enrolling && !lost && library?.problem && library.surfaces.length < 2;
}

const steps = ({ devices }) => ({
  kind: "idle", word: "Three steps", steps: { plugged: devices.some(({ state }) => state === "streaming") },
});

// The last scan in progress stays on screen until its answer arrives, but at most this long.
const ANSWER_WITHIN_MS = 1500;
let last = null;

// The state to show; `answer` is the last answer of this session, or null.
function stateOf(state, answer) {
  if (state.phase !== null) {
    const { scan } = state;
    last = { scan, shown: dragging(state), until: Date.now() + ANSWER_WITHIN_MS };
    return last.shown;
  }
  if (last && !state.enrolling && (answer?.scan ?? 0) < last.scan && Date.now() < last.until) return last.shown;
  if (!state.finished) {
    if (isEmpty(state)) return steps(state);
    if (state.advice.device) return disconnected(state);
    if (state.enrolling) return { ...idle(state), word: "Tap, then drag", name: state.enrolling.surface };
  }
  if (!answer) return idle(state);
  const isStale = time() - answer.unix_ms > state.stale_after_s * 1000;
  return isStale ? { ...idle(state), ...lastScan(answer) } : answered(answer, state.library?.surfaces.length ?? 0);
}

function runner([name, share, text]) {
  const item = make("li");
  const bar = make("div", undefined, "bar");
  const part = make("i");
  part.style.width = `${Math.max(0, Math.min(1, share)) * 100}%`;
  bar.append(part);
  item.append(make("span", name), bar, make("b", text));
  item.title = printable(name);
  return item;
}

const longest = (name) => Math.max(4, ...parts(name).flatMap((part) => part.split(/[\s-]/)).map((word) => word.length));

export function showNow(state, answer) {
  show(stateOf(state, answer));
  $("start").disabled = state.finished || state.phase !== null || state.advice.do === "wait";
  $("stop").disabled = state.finished || state.phase === null;
}

// A station that is not heard: what it last said may be wrong by now.
export function showOffline(answer) {
  show({ ...(answer ? lastScan(answer) : {}), kind: "offline", word: lostText(), sure: "The station does not answer. The page tries again." });
  [$("start").disabled, $("stop").disabled] = [true, true];
}

function show({ kind, word, name = "", sure = "", at = "", label = "", damage = [], done, id, steps, ...now }) {
  $("now").dataset.state = kind;
  document.body.dataset.state = kind;
  $("sign").firstElementChild.setAttribute("href", `#sign-${kind}`);
  say("word", word);
  say("name", name);
  $("name").dataset.faint = String(Boolean(now.faint));
  // Chooses the font size so that the longest word fits on one line.
  $("name").style.setProperty("--longest", Math.min(longest(name), 24));
  say("sure", sure);
  say("at", at);
  say("answer-label", label);
  hide("why", !id);
  if (id) $("why").href = `#scan=${id}`;
  fill("damage", damage.map((line) => make("li", line)));
  $("time").firstElementChild.style.width = `${Math.min(1, done ?? 0) * 100}%`;
  hide("time", done === undefined);
  fill("runners", (now.runners ?? []).slice(0, 4).map(runner));
  hide("steps", !steps);
  if (steps) $("step-plug").dataset.done = String(steps.plugged);
}

// In view `kiosk`, keeps the screen awake while the page is visible.
async function stayAwake() {
  if (document.hidden) return;
  try {
    await navigator.wakeLock.request("screen");
    document.body.dataset.awake = "true";
  } catch {
    // The browser refuses this if the page comes from another machine without encryption.
    document.body.dataset.awake = "false";
  }
}

if (new URLSearchParams(location.search).get("view") === "kiosk") {
  document.body.dataset.view = "kiosk";
  document.addEventListener("visibilitychange", stayAwake);
  stayAwake();
}
