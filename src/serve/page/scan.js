// One scan, opened: what it looked like, why it was named so, and what it truly was.

import { certainty, corrected, nameOf } from "./answer.js";
import { spectra, traces } from "./chart.js";
import { $, ask, button, clock, hide, make, percent, say } from "./dom.js";

const dialog = $("scan");
let open = null;
// The address that opened it.
let address = "";
let before = null;

const digits = (p) => (p === null ? "none" : p.toFixed(p < 0.1 ? 3 : 2));

function heading(text) {
  return make("h3", text);
}

// What a source says, as a bar to the left for the winner or to the right for the runner-up.
function says(source, most) {
  const item = make("li");
  const bar = make("div", undefined, "weigh");
  const part = make("i", undefined, source.for_winner < 0 ? "against" : "for");
  part.style.width = `${(50 * Math.abs(source.for_winner ?? 0)) / most}%`;
  bar.append(part);
  const value = source.for_winner === null ? "" : Math.abs(source.for_winner).toFixed(1);
  item.append(make("span", source.source), bar, make("b", value));
  const alone = `alone it would say ${source.alone ?? "nothing"}`;
  item.append(make("small", alone));
  return item;
}

function reasons(why) {
  const box = make("section");
  box.append(heading("Why"));
  const parts = [];
  if (why.threshold !== null) {
    parts.push(`p = ${digits(why.p_value)}; ${digits(why.threshold)} or less is unknown (from ${why.threshold_trials} left-out trials)`);
  } else parts.push("Unknown surfaces are not detected.");
  box.append(make("p", parts.join(" ")));
  if (why.sources.length && why.runner_up) {
    const legend = make("p", undefined, "versus");
    legend.append(make("span", `for ${why.winner}`, "for"), make("span", `for ${why.runner_up}`, "against"));
    const most = Math.max(1e-9, ...why.sources.map((source) => Math.abs(source.for_winner ?? 0)));
    const list = make("ul", undefined, "says");
    list.setAttribute("aria-label", `what each source says for ${why.winner} and for ${why.runner_up}`);
    list.append(...why.sources.map((source) => says(source, most)));
    box.append(legend, list);
  }
  for (const line of why.left_out) box.append(make("p", `Not compared: ${line}`, "soft"));
  return box;
}

// As it was answered.
function ranking(scan) {
  const box = make("section");
  if (scan.ranked.length === 0) return box;
  box.append(heading("Ranking"));
  const list = make("ol", undefined, "ranking");
  const share = (score) => (scan.confidence !== null ? percent(1 / score) : score.toPrecision(3));
  for (const { surface, score } of scan.ranked.slice(0, 8)) {
    const item = make("li");
    item.append(make("span", surface), make("b", share(score)));
    list.append(item);
  }
  box.append(list);
  return box;
}

function signal(scan, own, nearest) {
  const figure = make("figure");
  const head = make("figcaption");
  head.append(make("strong", own.source), make("span", `${own.duration_s.toFixed(2)} s at ${own.rate_hz.toLocaleString("en")} Hz`));
  if (own.audible) {
    const sound = make("audio");
    sound.controls = true;
    sound.preload = "none";
    sound.src = `/api/v1/scans/${scan.id}/${own.source}.wav`;
    sound.setAttribute("aria-label", `sound of ${own.source}`);
    head.append(sound);
  }
  figure.append(head, traces(own.source, own, nearest));
  if (own.spectrum) figure.append(spectra(own.source, own, nearest));
  return figure;
}

function picture(source, path, caption) {
  const figure = make("figure", undefined, "picture");
  const image = make("img");
  image.src = path;
  image.alt = `${source} of ${caption}`;
  figure.append(image, make("figcaption", `${source}, ${caption}`));
  return figure;
}

function signals(scan, { scan: own, nearest }) {
  const box = make("section");
  box.append(heading("Signals"));
  if (nearest) {
    const { surface, user, number } = nearest.trial;
    const legend = make("p", undefined, "legend");
    legend.append(make("span", "this scan", "own"), make("span", `nearest trial: ${surface}, ${user}, ${number}`, "nearest"));
    box.append(legend);
  }
  const grid = make("div", undefined, "figures");
  const of = (source) => nearest?.series.find((other) => other.source === source) ?? null;
  grid.append(...own.series.map((series) => signal(scan, series, of(series.source))));
  for (const source of own.pictures) {
    grid.append(picture(source, `/api/v1/scans/${scan.id}/${source}.png`, "this scan"));
    if (nearest?.pictures.includes(source)) {
      grid.append(picture(source, `/api/v1/scans/${scan.id}/nearest-${source}.jpg`, "the nearest trial"));
    }
  }
  box.append(grid);
  return box;
}

// The forms that say what it was.
function showCorrection(scan) {
  const spoiled = scan.spoiled.length > 0;
  const parts = [scan.correction ? corrected(scan) : "Not reviewed yet."];
  if (scan.became) parts.push(`trial ${scan.became}`);
  else if (scan.correction?.was === "surface" && spoiled) parts.push("it is spoiled, and no good trial");
  say("was-now", parts.join(" · "));
  hide("was-right", scan.surface === null);
  hide("was-clear", !scan.correction);
  hide("keep-form", scan.correction?.was !== "surface" || Boolean(scan.became) || !scan.kept || spoiled);
}

function showHead(scan) {
  say("scan-title", nameOf(scan));
  const when = new Date(scan.unix_ms).toLocaleDateString("en-GB", { day: "numeric", month: "long" });
  say("scan-about", `scan ${scan.scan}, ${when} ${clock(scan.unix_ms)} · ${certainty(scan)}`);
  showCorrection(scan);
}

async function load(id) {
  const wanted = location.hash;
  const scan = await ask(`scans/${encodeURIComponent(id)}`);
  // Closed in the meantime, or another one.
  if (!scan || location.hash !== wanted) return;
  if (open?.id !== scan.id) $("was").value = "";
  [open, address] = [scan, wanted];
  showHead(scan);
  const body = $("scan-body");
  body.replaceChildren();
  if (!dialog.open) {
    before = document.activeElement;
    dialog.showModal();
  }
  if (!scan.kept) {
    body.append(ranking(scan), make("p", "The signals of this scan are not kept (any more).", "empty"));
    return;
  }
  const notes = await ask(`scans/${scan.id}/why`);
  if (open !== scan) return;
  // Of a scan just before an end, or one of many at once.
  if (!notes) {
    body.append(ranking(scan, scan.ranked));
    return;
  }
  if (notes.why) body.append(reasons(notes.why));
  body.append(ranking(scan), signals(scan, notes));
  dialog.dataset.shown = scan.id;
}

async function correct(was) {
  const scan = await ask(`scans/${open.id}/correct`, was);
  if (!scan) return;
  open = scan;
  showHead(scan);
}

function follow() {
  const id = location.hash.startsWith("#scan=") ? decodeURIComponent(location.hash.slice(6)) : null;
  if (id) load(id);
  else if (dialog.open) dialog.close();
}

dialog.addEventListener("close", () => {
  // A correction draws the row anew.
  const row = open && `#scans tr[data-id="${CSS.escape(open.id)}"] button`;
  const back = before?.isConnected ? before : row && document.querySelector(row);
  open = null;
  delete dialog.dataset.shown;
  // By now the address may be that of another scan.
  if (location.hash === address) history.pushState(null, "", "/");
  back?.focus();
});
$("scan-close").addEventListener("click", () => dialog.close());
$("was-right").addEventListener("click", () => correct({ surface: open.surface }));
$("was-unknown").addEventListener("click", () => correct({ unknown: true }));
$("was-bad").addEventListener("click", () => correct({ bad: true }));
$("was-clear").addEventListener("click", () => correct({}));
$("was-form").addEventListener("submit", (event) => {
  event.preventDefault();
  correct({ surface: $("was").value });
});
$("keep-form").addEventListener("submit", async (event) => {
  event.preventDefault();
  const scan = await ask(`scans/${open.id}/keep`, { user: $("keep-user").value });
  if (!scan) return;
  open = scan;
  showHead(scan);
});
window.addEventListener("hashchange", follow);
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => open && load(open.id));
follow();
