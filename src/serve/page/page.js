// Follows the station's events and shows how it is. All text from outside goes in as text, never
// as markup.

import { certainty, nameOf } from "./answer.js";
import * as camera from "./camera.js";
import { $, ask, button, clock, fill, hide, make, many, percent, printable, say, times } from "./dom.js";
import { devices, losses, show, spectrum, trace } from "./draw.js";
import * as history from "./history.js";
import * as precision from "./precision.js";
import "./scan.js";
import * as shelf from "./shelf.js";

let state = null;
let enrolled = [];
let announced = "";
let due = false;

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

// The last scan of this session that was named, or the one after it that could not be.
function lastAnswer() {
  const last = history.newest();
  const since = state.answer?.unix_ms ?? state.started_unix_ms;
  return last?.state === "unnamed" && last.unix_ms > since ? last : state.answer;
}

function showNow() {
  const { advice, phase } = state;
  const guess = state.guess?.scan === state.scan ? state.guess : null;
  const answer = lastAnswer();
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
    const made = answer.synthetic ? " · synthetic" : "";
    const next = phase === null ? "" : ` · scan ${state.scan} goes on`;
    label(`scan ${answer.scan}${made}${next}`, nameOf(answer), answer.state, certainty(answer));
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
  }).concat(state.outputs.filter(({ problem }) => problem).map(({ output, problem, waiting }) => {
    const item = make("li", `${printable(output)} · ${many(waiting, "answer")} waiting`);
    item.dataset.state = "lost";
    item.title = printable(problem);
    return item;
  })));
  const lost = state.streams.reduce((sum, stream) => sum + stream.lost, 0);
  say("lost", state.streams.length === 0 ? "" : lost === 0 ? "nothing lost" : `${lost.toLocaleString("en")} samples lost`);
  losses(state.streams);
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
  hide("shelf-open", !state.enrolls);
  hide("enroll-form", !state.enrolls);
  hide("no-enroll", state.enrolls);
  hide("enrolling", !enrolling);
  if (enrolling) {
    say("enrolling-what", enrolling.surface);
    say("enrolling-wanted", enrolling.wanted === null ? "every scan is kept"
      : `${enrolling.wanted} more ${enrolling.wanted === 1 ? "trial" : "trials"}: tap and drag`);
  }
  showEnrolled();
}

// Each trial as it is kept, with a way back.
function showEnrolled() {
  const text = JSON.stringify(enrolled);
  if ($("enrolled").dataset.text === text) return;
  $("enrolled").dataset.text = text;
  $("enrolled").replaceChildren(...enrolled.map((e) => {
    const kept = e.trial === null ? `scan ${e.scan} was not kept as ${e.surface}` : `scan ${e.scan} kept as ${e.surface}, trial ${e.trial}`;
    const item = make("li", [kept, ...e.remarks].join(" · "));
    const looksLike = e.nearest && e.nearest !== e.surface && !e.undone && !e.confirmed;
    if (looksLike) {
      item.append(make("p", `This looks like ${e.nearest}, which you have. Is it ${e.surface}?`, "warn"));
      item.append(button(`Yes, ${e.surface}`, () => {
        e.confirmed = true;
        render();
      }, "small"));
    }
    if (e.undone) item.append(make("span", "taken back", "badge"));
    else if (e.folder) {
      const name = e.folder.split("/").slice(-2).join("/");
      const back = button(looksLike ? "No, take it back" : "Undo", async () => {
        if (!(await ask("library/remove", { trials: [name] }))) return;
        e.undone = true;
        render();
      }, "small");
      back.setAttribute("aria-label", printable(`take back ${name}`));
      item.append(back);
    }
    return item;
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
    history.render(state.counts);
    showLibrary();
    showWarnings();
    say("version", `surfaced ${state.version}`);
  });
}

// A scan was named, or could not be.
function answered(answer) {
  if (answer.state !== "unnamed") state.answer = answer;
  if (answer.state !== "named") state.counts[answer.state] += 1;
  history.add(answer);
  announce(`scan ${answer.scan}: ${nameOf(answer)}, ${certainty(answer)}`);
}

// What each type of event changes.
const changes = {
  state: (whole) => {
    state = whole;
    camera.view(state.camera);
    devices(state.devices);
    history.load();
    precision.load();
  },
  camera: camera.view,
  outputs: (outputs) => (state.outputs = outputs),
  advice: (advice) => (state.advice = advice),
  device: (device) => {
    state.devices = state.devices.filter((other) => other.device !== device.device).concat(device);
    state.devices.sort((a, b) => (a.device < b.device ? -1 : 1));
    devices(state.devices);
  },
  phase: ({ scan, phase }) => ([state.scan, state.phase] = [phase === null ? null : scan, phase]),
  guess: (guess) => (state.guess = guess),
  answer: (answer) => {
    state.counts.scans += 1;
    answered(answer);
  },
  unnamed: answered,
  correction: (scan) => {
    history.change(scan);
    precision.load();
  },
  check: shelf.checked,
  enrolled: (e) => (enrolled = [e, ...enrolled].slice(0, 5)), // #enrolled is a live region itself
  enrolling: (enrolling) => (state.enrolling = enrolling),
  reading: (reading) => (state.reading = reading),
  library: (library) => {
    [state.library, state.reading] = [library, false];
    shelf.changed();
  },
  warning: (warning) => (state.warnings = [warning, ...state.warnings].slice(0, 50)),
  streams: ({ streams }) => (state.streams = streams),
  finished: (counts) => {
    state.counts = counts;
    [state.finished, state.phase, state.scan] = [true, null, null];
  },
};

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
  // A page that is left keeps no connection: a browser has six for each station.
  window.addEventListener("pagehide", () => events.close(), { once: true });
  events.addEventListener("trace", ({ data }) => trace(JSON.parse(data)));
  events.addEventListener("spectrum", ({ data }) => spectrum(JSON.parse(data)));
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

$("start").addEventListener("click", () => ask("start", {}));
$("stop").addEventListener("click", () => ask("stop", {}));
$("reload").addEventListener("click", () => ask("reload", {}));
$("enroll-end").addEventListener("click", () => ask("enroll/end", {}));
$("view-traces").addEventListener("click", () => choose("traces"));
$("view-spectra").addEventListener("click", () => choose("spectra"));
$("older").addEventListener("click", history.older);
$("unknown-only").addEventListener("change", render);
history.onChange(render);
$("enroll-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const body = { surface: $("surface").value, user: $("user").value, trials: Number($("trials").value) };
  if (await ask("enroll", body)) $("surface").value = "";
});

const keys = {
  s: () => $("start").click(),
  x: () => $("stop").click(),
  e: () => $("surface").focus(),
  v: toggleView,
  u: () => $("unknown-only").click(),
};
document.addEventListener("keydown", (event) => {
  const writing = event.target.closest("input:not([type=checkbox]), select");
  if (event.key === "Escape" && writing) writing.blur();
  if (writing || document.querySelector("dialog[open]") || event.ctrlKey || event.metaKey || event.altKey || !keys[event.key]) return;
  event.preventDefault();
  keys[event.key]();
});

window.addEventListener("pageshow", ({ persisted }) => persisted && follow());
follow();
