// Receives the station's events and shows its state. Text from outside is inserted as text, never
// as markup.

import { certainty, nameOf } from "./answer.js";
import * as camera from "./camera.js";
import "./changes.js";
import { $, ask, clock, fill, hide, make, many, printable, say, zone } from "./dom.js";
import { devices, losses, show, spectrum, trace } from "./draw.js";
import * as drift from "./drift.js";
import * as enrol from "./enrol.js";
import * as history from "./history.js";
import * as link from "./link.js";
import { isEmpty, showNow, showOffline } from "./now.js";
import { learnRole } from "./person.js";
import { follow as followAddress } from "./route.js";
import "./scan.js";
import * as shelf from "./shelf.js";

// Keys that are closer together come from a barcode scanner.
const BURST_MS = 50;
const TYPING_MS = 300;
// States of scans that somebody should look at.
const DOUBTFUL = "unknown,unsure,unnamed";
let state = null;
let filtering = 0;
let announced = "";
let due = false;

// The last answer of this session, or a later scan that could not be named.
function lastAnswer() {
  const last = history.newest();
  const since = state.answer?.unix_ms ?? state.started_unix_ms;
  return last?.state === "unnamed" && last.unix_ms > since ? last : state.answer;
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
  const all = state.streams.length > 0 && !state.advice.device;
  say("lost", lost > 0 ? `${lost.toLocaleString("en")} samples lost` : all ? "nothing lost" : "");
  losses(state.streams);
}

function showLibrary() {
  const { library } = state;
  const surfaces = library?.surfaces ?? [];
  const name = surfaces.length > 0 && `${library.name}${library.synthetic ? " (synthetic)" : ""} · ${many(surfaces.length, "surface")}`;
  say("library-name", [name, state.reading ? "reading the library …" : ""].filter(Boolean).join(" · "));
  $("reload").disabled = state.reading || state.finished;
  const problem = isEmpty(state) ? null : library?.problem;
  hide("library-problem", !problem);
  say("library-problem", problem ?? "");
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
  drift.show(library?.reference ?? {}, state.drift);
}

function showWarnings() {
  // For a station without surfaces, the page shows three steps instead of this problem.
  const known = isEmpty(state) ? state.library.problem : null;
  const warnings = state.warnings.filter(({ text }) => text !== known);
  hide("warnings-box", warnings.length === 0);
  fill("warnings", warnings.slice(0, 20).map(({ unix_ms, text }) => {
    const item = make("li");
    item.append(make("time", clock(unix_ms)), make("span", text));
    return item;
  }));
}

function showLink() {
  const lost = link.isLost();
  $("link").dataset.state = lost ? "lost" : state ? "connected" : "";
  say("link", lost ? link.lostText() : state ? "connected" : "connecting");
}

function render() {
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    showLink();
    if (link.isLost()) return showOffline(state && lastAnswer());
    if (!state) return;
    showNow(state, lastAnswer());
    showDevices();
    history.render(state.counts);
    showLibrary();
    enrol.show(state);
    showWarnings();
    say("version", `surfaced ${state.version}`);
    say("zone", zone());
  });
}

// Handles a new answer, named or not.
function answered(answer) {
  if (answer.state !== "unnamed") state.answer = answer;
  if (answer.state !== "named") state.counts[answer.state] += 1;
  history.add(answer);
  announce(`scan ${answer.scan}: ${nameOf(answer)}, ${certainty(answer)}`);
}

// How each type of event changes the page.
const changes = {
  state: (whole) => {
    state = whole;
    link.heard(state.now_unix_ms);
    camera.view(state.camera);
    devices(state.devices);
    history.load();
    learnRole();
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
    state.counts.damaged += Number(answer.damage.length > 0);
    answered(answer);
  },
  unnamed: answered,
  correction: history.change,
  check: shelf.checked,
  drift: (doubts) => {
    state.drift = doubts;
    drift.changed();
  },
  enrolled: enrol.add, // #enrolled is a live region itself
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

// While nothing is heard, a new connection is tried this often: a browser gives up one that is refused,
// and never gives up one that is merely silent.
const RETRY_MS = 5000;
let events = null;

function follow() {
  events?.close();
  events = new EventSource("api/v1/events");
  const on = (type, act) => events.addEventListener(type, ({ data }) => {
    link.heard();
    act(JSON.parse(data));
  });
  for (const [type, change] of Object.entries(changes)) {
    on(type, (data) => {
      if (!state && type !== "state") return;
      change(data);
      render();
    });
  }
  on("trace", trace);
  on("spectrum", spectrum);
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

$("step-name").addEventListener("click", () => $("surface").focus());
$("start").addEventListener("click", () => ask("start", {}));
$("stop").addEventListener("click", () => ask("stop", {}));
$("reload").addEventListener("click", () => ask("reload", {}));
$("view-traces").addEventListener("click", () => choose("traces"));
$("view-spectra").addEventListener("click", () => choose("spectra"));
$("older").addEventListener("click", history.older);
$("filter").addEventListener("input", () => {
  clearTimeout(filtering);
  filtering = setTimeout(history.load, TYPING_MS);
});
$("filter").addEventListener("submit", (event) => event.preventDefault());
history.onChange(render);
const keys = {
  s: () => $("start").click(),
  x: () => $("stop").click(),
  e: () => $("surface").focus(),
  v: toggleView,
  u: () => {
    $("filter-state").value = $("filter-state").value === "" ? DOUBTFUL : "";
    history.load();
  },
};
// A barcode scanner types as fast as nobody does: what it types is no shortcut.
let key = { at: -Infinity, timer: 0 };
function press(act) {
  clearTimeout(key.timer);
  const now = performance.now();
  const timer = act && now - key.at > BURST_MS ? setTimeout(act, BURST_MS) : 0;
  key = { at: now, timer };
}
document.addEventListener("keydown", (event) => {
  const writing = event.target.closest("input:not([type=checkbox]), select");
  if (event.key === "Escape" && writing) writing.blur();
  else if (event.key === "Escape" && document.body.dataset.view === "kiosk") location.assign("./");
  if (writing || document.querySelector("dialog[open]") || event.ctrlKey || event.metaKey || event.altKey) return;
  if (keys[event.key]) event.preventDefault();
  if (event.key.length === 1) press(keys[event.key]);
});

// A browser allows only six connections to a station, so a page closes its own when it is left.
window.addEventListener("pagehide", () => {
  events.close();
  events = null;
});
window.addEventListener("pageshow", ({ persisted }) => persisted && follow());
follow();
followAddress();
link.watch(render);
setInterval(() => events && link.isLost() && follow(), RETRY_MS);
// Answers grow old, and so does the time since which a device has been disconnected.
setInterval(render, 1000);
