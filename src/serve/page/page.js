// Follows the station's events and shows how it is. All text from outside goes in as text, never
// as markup.

import { losses, show, spectrum, trace } from "./draw.js";

const $ = (id) => document.getElementById(id);
const HISTORY = 300;
let state = null;
let scans = [];
let enrolled = [];
let announced = "";
let due = false;

// Text without what acts unseen, such as marks that make it read backwards (as printable.rs).
const UNSEEN = /[\u0000-\u0008\u000b-\u001f\u007f-\u009f\u061c\u200b\u200e\u200f\u2028-\u202e\u2060-\u206f\ufeff\ufff9-\ufffb]|[\u{e0000}-\u{e007f}]/gu;
const printable = (text) => String(text).replace(UNSEEN, (c) => `\\u{${c.codePointAt(0).toString(16)}}`);

function make(tag, text, className) {
  const element = document.createElement(tag);
  if (text !== undefined) element.textContent = printable(text);
  if (className) element.className = className;
  return element;
}

const percent = (share) => `${(share * 100).toFixed(share > 0.995 && share < 1 ? 1 : 0)} %`;
const many = (count, what) => `${count} ${what}${count === 1 ? "" : "s"}`;
const clock = (ms) => new Date(ms).toLocaleTimeString("en-GB");

// What is shown in one place: a list of elements, replaced only if it reads otherwise.
function fill(id, elements) {
  const place = $(id);
  const text = elements.map((element) => element.outerHTML).join("");
  if (place.dataset.text === text) return;
  place.dataset.text = text;
  place.replaceChildren(...elements);
}

function say(id, text) {
  const shown = printable(text);
  if ($(id).textContent !== shown) $(id).textContent = shown;
}

function hide(id, hidden) {
  $(id).hidden = hidden;
}

const times = (ratio) => (ratio >= 1000 ? "> 1000 ×" : `${ratio.toFixed(ratio < 10 ? 1 : 0)} ×`);

// How sure an answer is, in words: by its probability where the method gives one.
function sureness(answer) {
  return answer.confidence !== null ? percent(answer.confidence) : times(Math.exp(answer.margin));
}

function sureText(answer) {
  const parts = [];
  if (answer.surface === null) parts.push(`most alike: ${answer.ranked[0]?.surface ?? "nothing"}`);
  else if (answer.confidence !== null) parts.push(`${percent(answer.confidence)} sure`);
  else parts.push(answer.margin < 0.05 ? "no more alike than the next" : `${sureness(answer)} more alike than the next`);
  parts.push(`answered in ${answer.latency_ms.toFixed(0)} ms`);
  if (answer.truth) parts.push(answer.truth === answer.surface ? "right" : `it was ${answer.truth}`);
  return parts.join(" · ");
}

function runner(name, share, text) {
  const item = make("li");
  const bar = make("div", undefined, "bar");
  const fill = make("i");
  fill.style.width = `${Math.max(0, Math.min(1, share)) * 100}%`;
  bar.append(fill);
  item.append(make("span", name), bar, make("b", text));
  item.title = printable(name);
  return item;
}

// Scores are inverse probabilities where the method gives these, and else distances.
function answerRunners(answer) {
  const best = answer.ranked[0]?.score ?? 1;
  const share = (score) => (answer.confidence !== null ? 1 / score : score > 0 ? best / score : 1);
  const text = (score) =>
    answer.confidence !== null ? percent(1 / score) : score > best ? `${times(score / best)} as far` : "nearest";
  return answer.ranked.slice(0, 4).map(({ surface, score }) => runner(surface, share(score), text(score)));
}

function showNow() {
  const { advice, phase, guess, answer } = state;
  say("advice", advice.text);
  $("advice").dataset.do = advice.do;
  const needed = guess?.needed_s ?? null;
  const far = phase === "drag" && guess ? guess.scan_s : 0;
  $("time").firstElementChild.style.width = needed ? `${Math.min(1, far / needed) * 100}%` : "0";
  say("time-text", guess && phase ? `${far.toFixed(1)} s${needed ? ` of ${needed.toFixed(1)} s` : ""}` : "");
  $("start").disabled = state.finished || phase !== null || advice.do === "wait";
  $("stop").disabled = state.finished || phase === null;
  const label = (text, name, kind, sure) => {
    say("answer-label", text);
    say("name", name);
    $("name").dataset.kind = kind;
    say("sure", sure);
  };
  const guessing = phase !== null && guess?.named.length > 0;
  const spoiled = answer && !guessing ? answer.spoiled : [];
  hide("spoiled", spoiled.length === 0);
  say("spoiled", spoiled.join(" · "));
  if (guessing) {
    const [first] = guess.named;
    label(`scan ${guess.scan}, so far`, first.surface, "guess", `${percent(first.probability)}${guess.settled ? " · settled" : ""}`);
    fill("runners", guess.named.slice(0, 4).map((n) => runner(n.surface, n.probability, percent(n.probability))));
  } else if (answer) {
    const kind = answer.surface === null ? "unknown" : "answer";
    const made = answer.synthetic ? " · synthetic" : "";
    const next = phase === null ? "" : ` · scan ${state.scan} goes on`;
    label(`scan ${answer.scan}${made}${next}`, answer.surface ?? "unknown", kind, sureText(answer));
    fill("runners", answerRunners(answer));
  } else {
    label(phase === null ? "no scan yet" : `scan ${state.scan} goes on`, "—", "none", "");
    fill("runners", []);
  }
}

function announce(text) {
  if (text === announced) return;
  announced = text;
  say("announce", text);
}

function showDevices() {
  fill("devices", state.devices.map(({ device, state: how, detail }) => {
    const item = make("li", `${device} · ${how}`);
    item.dataset.state = how;
    item.title = printable(detail);
    return item;
  }));
  const lost = state.streams.reduce((sum, stream) => sum + stream.lost, 0);
  say("lost", state.streams.length === 0 ? "" : lost === 0 ? "nothing lost" : `${lost.toLocaleString("en")} samples lost`);
  losses(state.streams);
}

function row(scan) {
  const unknown = scan.surface === null;
  const line = make("tr", undefined, unknown ? "unknown" : "");
  const name = make("td", unknown ? "unknown" : scan.surface);
  if (unknown && scan.ranked[0]) name.append(make("span", `like ${scan.ranked[0].surface}`, "badge"));
  if (scan.spoiled.length) {
    const badge = make("span", "spoiled", "badge");
    badge.title = printable(scan.spoiled.join("\n"));
    name.append(badge);
  }
  line.append(make("td", scan.scan), make("td", clock(scan.unix_ms)), name, make("td", sureness(scan)),
    make("td", `${scan.scan_s.toFixed(1)} s`, "wide"), make("td", `${scan.latency_ms.toFixed(0)} ms`, "wide"),
    make("td", scan.lost_samples));
  return line;
}

function showHistory() {
  const only = $("unknown-only").checked;
  const shown = scans.filter((scan) => !only || scan.surface === null);
  fill("scans", shown.map(row));
  hide("no-scans", shown.length > 0);
  const { scans: count, unknown } = state.counts;
  say("counts", count ? `${many(count, "scan")} · ${unknown} unknown` : "");
}

function showLibrary() {
  const { library, enrolling } = state;
  const surfaces = library?.surfaces ?? [];
  const name = library && `${library.name}${library.synthetic ? " (synthetic)" : ""} · ${many(surfaces.length, "surface")}`;
  say("library-name", [name, state.reading ? "reading the library …" : ""].filter(Boolean).join(" · "));
  $("reload").disabled = state.reading || state.finished;
  hide("library-problem", !library?.problem);
  say("library-problem", library?.problem ?? "");
  fill("surfaces", surfaces.map(({ surface, trials }) => {
    const item = make("li", surface);
    item.append(make("b", trials));
    return item;
  }));
  fill("labels", surfaces.map(({ surface }) => {
    const option = make("option");
    option.value = surface;
    return option;
  }));
  hide("enroll-form", !state.enrolls);
  hide("no-enroll", state.enrolls);
  hide("enrolling", !enrolling);
  if (enrolling) {
    say("enrolling-what", enrolling.surface);
    say("enrolling-wanted", enrolling.wanted === null ? "every scan is kept"
      : `${enrolling.wanted} more ${enrolling.wanted === 1 ? "trial" : "trials"}: tap and drag`);
  }
  fill("enrolled", enrolled.map((e) => {
    const kept = e.trial === null ? `scan ${e.scan} was not kept as ${e.surface}` : `scan ${e.scan} kept as ${e.surface}, trial ${e.trial}`;
    return make("li", [kept, ...e.remarks].join(" · "));
  }));
}

function showWarnings() {
  hide("warnings-box", state.warnings.length === 0);
  fill("warnings", state.warnings.slice(0, 20).map(({ unix_ms, text }) => {
    const item = make("li");
    item.append(make("time", clock(unix_ms)), make("span", text));
    return item;
  }));
}

function render() {
  if (due || !state) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    showNow();
    showDevices();
    showHistory();
    showLibrary();
    showWarnings();
    say("version", `surfaced ${state.version}`);
  });
}

// What each type of event changes.
const changes = {
  state: (whole) => {
    state = whole;
    fetchScans();
  },
  advice: (advice) => (state.advice = advice),
  device: (device) => {
    state.devices = state.devices.filter((other) => other.device !== device.device).concat(device);
    state.devices.sort((a, b) => (a.device < b.device ? -1 : 1));
  },
  phase: ({ scan, phase }) => {
    if (state.scan !== scan || phase === null) state.guess = null;
    [state.scan, state.phase] = [phase === null ? null : scan, phase];
  },
  guess: (guess) => (state.guess = guess),
  answer: (answer) => {
    state.answer = answer;
    state.guess = null;
    state.counts.scans += 1;
    state.counts.unknown += answer.surface === null ? 1 : 0;
    scans = [answer, ...scans].slice(0, HISTORY);
    announce(`scan ${answer.scan}: ${answer.surface ?? "unknown"}, ${sureText(answer)}`);
  },
  enrolled: (e) => (enrolled = [e, ...enrolled].slice(0, 5)), // #enrolled is a live region itself
  enrolling: (enrolling) => (state.enrolling = enrolling),
  reading: (reading) => (state.reading = reading),
  library: (library) => ([state.library, state.reading] = [library, false]),
  warning: (warning) => (state.warnings = [warning, ...state.warnings].slice(0, 50)),
  streams: ({ streams }) => (state.streams = streams),
  finished: (counts) => {
    state.counts = counts;
    [state.finished, state.phase, state.scan, state.guess] = [true, null, null, null];
  },
};

async function fetchScans() {
  const answer = await fetch(`/api/v1/scans?limit=${HISTORY}`);
  if (!answer.ok) return;
  scans = (await answer.json()).scans;
  render();
}

function follow() {
  const events = new EventSource("/api/v1/events");
  const link = (how, text) => {
    $("link").dataset.state = how;
    say("link", text);
  };
  events.onopen = () => link("connected", "connected");
  events.onerror = () => link("lost", "reconnecting");
  for (const [type, change] of Object.entries(changes)) {
    events.addEventListener(type, ({ data }) => {
      if (!state && type !== "state") return;
      change(JSON.parse(data));
      render();
    });
  }
  events.addEventListener("trace", ({ data }) => trace(JSON.parse(data)));
  events.addEventListener("spectrum", ({ data }) => spectrum(JSON.parse(data)));
}

async function order(path, body) {
  let problem = "";
  try {
    const answer = await fetch(`/api/v1/${path}`, {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: body && JSON.stringify(body),
    });
    if (!answer.ok) problem = (await answer.json()).message;
  } catch {
    problem = "The station does not answer; is it still running?";
  }
  hide("problem", problem === "");
  say("problem", problem);
  return problem === "";
}

function toggleView() {
  const spectra = $("view-traces").getAttribute("aria-pressed") === "true";
  choose(spectra ? "spectra" : "traces");
}

function choose(view) {
  $("view-traces").setAttribute("aria-pressed", String(view === "traces"));
  $("view-spectra").setAttribute("aria-pressed", String(view === "spectra"));
  show(view);
}

$("start").addEventListener("click", () => order("start"));
$("stop").addEventListener("click", () => order("stop"));
$("reload").addEventListener("click", () => order("reload"));
$("enroll-end").addEventListener("click", () => order("enroll/end"));
$("view-traces").addEventListener("click", () => choose("traces"));
$("view-spectra").addEventListener("click", () => choose("spectra"));
$("unknown-only").addEventListener("change", render);
$("enroll-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const body = { surface: $("surface").value, user: $("user").value, trials: Number($("trials").value) };
  if (await order("enroll", body)) $("surface").value = "";
});

const keys = {
  s: () => $("start").click(),
  x: () => $("stop").click(),
  e: () => $("surface").focus(),
  v: toggleView,
  u: () => $("unknown-only").click(),
};
document.addEventListener("keydown", (event) => {
  const writing = event.target.closest("input:not([type=checkbox])");
  if (event.key === "Escape" && writing) writing.blur();
  if (writing || event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
});

follow();
