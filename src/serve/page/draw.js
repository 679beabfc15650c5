// Draws the streams: the last seconds of each as a trace, or as a spectrum.

import { picture } from "./camera.js";
import { plain, sourceName } from "./dom.js";

const WINDOW_S = 6;
// A stream is shown as stalled after this long without data.
const STALLED_MS = 700;
// Number of columns of a spectrogram; five columns a second are added.
const COLUMNS = 60;
const TICKS_HZ = [10, 100, 1000, 10000];
const streams = new Map();
// The names of missing devices.
let gone = new Set();
let view = "traces";
let colours = {};
let due = false;
let frames = 0;

const place = document.getElementById("plots");

function readColours() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(name).trim();
  colours = { traces: [0, 1, 2].map((n) => of(`--trace-${n}`)), grid: of("--grid"), soft: of("--soft"), idle: of("--idle"), bad: of("--bad") };
  ask();
}

function stream(source) {
  let known = streams.get(source);
  if (known) return known;
  place.querySelector(".empty")?.remove();
  const box = document.createElement("figure");
  box.className = "plot";
  box.style.margin = "0";
  const head = document.createElement("div");
  const note = document.createElement("span");
  const lost = document.createElement("span");
  lost.className = "lost";
  const canvas = document.createElement("canvas");
  canvas.setAttribute("role", "img");
  canvas.setAttribute("aria-label", `signal of ${plain(source)}`);
  canvas.dataset.source = source;
  head.append(sourceName(source), note, lost);
  box.append(head, canvas);
  box.dataset.source = source;
  known = { source, box, canvas, note, lost, bins: [], bin_s: 0.005, spectrum: null, columns: [], fresh: false, range: null,
    arrived: performance.now(), stalled: false };
  streams.set(source, known);
  // Boxes are sorted by name, in whatever order the streams arrive.
  const after = [...place.children].find((other) =>
    other.classList.contains("camera") || other.dataset.source > source);
  place.insertBefore(box, after ?? null);
  return known;
}

// Handles an event of type `trace`.
export function trace(event) {
  for (const { source, bin_s, start_s, min, max, clipped } of event.streams) {
    const s = stream(source);
    const last = s.bins[s.bins.length - 1];
    const expected = last ? last.at + bin_s : start_s;
    if (start_s < expected - 1.5 * bin_s) s.bins = [];
    else if (start_s > expected + 1.5 * bin_s) s.bins.push({ at: expected, min: null });
    s.bin_s = bin_s;
    const count = min[0]?.length ?? 0;
    for (let i = 0; i < count; i++) {
      s.bins.push({ at: start_s + i * bin_s, min: min.map((m) => m[i]), max: max.map((m) => m[i]), clipped: clipped?.includes(i) });
    }
    const end = s.bins[s.bins.length - 1].at;
    const first = s.bins.findIndex((bin) => bin.at > end - WINDOW_S);
    s.bins.splice(0, first);
    s.fresh = true;
    s.arrived = performance.now();
    if (s.stalled && !gone.has(s.device)) revive(s);
  }
  for (const source of event.pictures ?? []) picture(place, source);
  if (view === "traces") ask();
}

function revive(s) {
  s.stalled = false;
  s.fresh = true;
  delete s.box.dataset.stalled;
  s.canvas.setAttribute("aria-label", `signal of ${plain(s.source)}`);
}

// Draws stalled streams in grey, with the time since the last sample: no old trace looks live.
function findStalled() {
  const now = performance.now();
  for (const s of streams.values()) {
    // Some streams of a replay have pauses, so a stream is stalled only if its device is silent.
    const device = [...streams.values()].filter((other) => other.device === s.device);
    const silent_ms = now - Math.max(...device.map((other) => other.arrived));
    if (silent_ms < STALLED_MS && !gone.has(s.device)) {
      if (s.stalled) revive(s);
      continue;
    }
    if (!s.stalled) {
      s.stalled = true;
      s.box.dataset.stalled = "true";
      s.fresh = true;
      s.columns = [];
      ask();
    }
    const text = `no data for ${(silent_ms / 1000).toFixed(silent_ms < 10000 ? 1 : 0)} s`;
    s.note.textContent = text;
    s.canvas.setAttribute("aria-label", `signal of ${plain(s.source)}: ${text}`);
  }
}
setInterval(findStalled, 250);

// Handles the states of the devices: streams of a missing device turn grey at once.
export function devices(list) {
  gone = new Set(list.filter(({ state }) => state === "lost" || state === "absent").map(({ device }) => device));
  findStalled();
}

// Handles an event of type `spectrum`.
export function spectrum(event) {
  for (const bands of event.streams) {
    const s = stream(bands.source);
    if (s.stalled) continue;
    s.spectrum = bands;
    s.columns.push(bands.db);
    s.columns.splice(0, s.columns.length - COLUMNS);
    if (view === "spectra") s.fresh = true;
  }
  if (view === "spectra") ask();
}

// Shows how many samples each stream has lost.
export function losses(list) {
  for (const { source, device, lost } of list) {
    const s = streams.get(source);
    if (!s) continue;
    s.device = device;
    s.lost.textContent = lost > 0 ? `${lost.toLocaleString("en")} lost` : s.stalled ? "" : "nothing lost";
    s.lost.dataset.any = String(lost > 0);
  }
}

// Switches the view between traces and spectra.
export function show(wanted) {
  view = wanted;
  for (const s of streams.values()) s.fresh = true;
  ask();
}

function ask() {
  if (due) return;
  due = true;
  requestAnimationFrame(() => {
    due = false;
    let any = false;
    for (const s of streams.values()) {
      if (!s.fresh) continue;
      s.fresh = false;
      any = true;
      draw(s);
    }
    if (any) place.dataset.frames = String(++frames);
  });
}

function draw(s) {
  const ratio = window.devicePixelRatio || 1;
  const { clientWidth, clientHeight, width, height } = s.canvas;
  const [w, h] = [Math.round(clientWidth * ratio), Math.round(clientHeight * ratio)];
  if (w !== width || h !== height) [s.canvas.width, s.canvas.height] = [w, h];
  const pen = s.canvas.getContext("2d");
  pen.clearRect(0, 0, w, h);
  if (view === "traces") drawTrace(s, pen, w, h, ratio);
  else drawSpectrum(s, pen, w, h, ratio);
}

// The bins of a stream, merged to at most one for each pixel. The same bins are always merged, so
// that the picture does not flicker as it moves. An entry without `min` is a gap.
function columns(s, w) {
  const wide = Math.max(1, Math.floor(WINDOW_S / s.bin_s / w));
  const all = [];
  let group = null;
  for (const { at, min, max, clipped } of s.bins) {
    const of = min ? Math.floor(Math.round(at / s.bin_s) / wide) : null;
    if (of === null || of !== group) {
      all.push(min ? { at, min: [...min], max: [...max], clipped } : { at, min: null });
    } else {
      const last = all[all.length - 1];
      last.clipped ||= clipped;
      for (let channel = 0; channel < min.length; channel++) {
        last.min[channel] = Math.min(last.min[channel], min[channel]);
        last.max[channel] = Math.max(last.max[channel], max[channel]);
      }
    }
    group = of;
  }
  return all;
}

function drawTrace(s, pen, w, h, ratio) {
  const bins = columns(s, w);
  let low = Infinity, high = -Infinity, channels = 0;
  for (const { min, max } of bins.filter((bin) => bin.min)) {
    low = Math.min(low, ...min);
    high = Math.max(high, ...max);
    channels = min.length;
  }
  if (channels === 0) return;
  const flat = Math.max(high - low, 1e-6 * Math.max(Math.abs(high), Math.abs(low)), 1e-9);
  const middle = (low + high) / 2;
  // The scale widens at once but narrows slowly, so that the picture does not flicker.
  const wanted = { low: middle - flat * 0.56, high: middle + flat * 0.56 };
  const was = s.range ?? wanted;
  const ease = (from, to) => from + (to - from) * 0.06;
  s.range = {
    low: wanted.low < was.low ? wanted.low : ease(was.low, wanted.low),
    high: wanted.high > was.high ? wanted.high : ease(was.high, wanted.high),
  };
  const end = s.bins[s.bins.length - 1].at + s.bin_s;
  const x = (at) => w * (1 - (end - at) / WINDOW_S);
  const y = (value) => h * (1 - (value - s.range.low) / (s.range.high - s.range.low));
  pen.fillStyle = colours.grid;
  for (let second = Math.ceil(end - WINDOW_S); second < end; second++) pen.fillRect(x(second), 0, ratio, h);
  for (let channel = channels - 1; channel >= 0; channel--) {
    pen.strokeStyle = s.stalled ? colours.idle : colours.traces[channel % colours.traces.length];
    pen.lineWidth = 1.2 * ratio;
    pen.beginPath();
    let drawing = false;
    for (const bin of bins) {
      if (!bin.min) { drawing = false; continue; }
      const at = x(bin.at);
      if (drawing) pen.lineTo(at, y(bin.max[channel]));
      else pen.moveTo(at, y(bin.max[channel]));
      pen.lineTo(at, y(bin.min[channel]));
      drawing = true;
    }
    pen.stroke();
  }
  // Marks at the top where a channel is clipped.
  const clipped = bins.filter((bin) => bin.clipped);
  pen.fillStyle = colours.bad;
  for (const bin of clipped) pen.fillRect(x(bin.at), 0, Math.max(w * s.bin_s / WINDOW_S, 2 * ratio), 4 * ratio);
  s.box.dataset.clipped = String(clipped.length > 0);
  s.canvas.title = clipped.length ? "clipped: lower the gain, or press less" : "";
  if (!s.stalled) s.note.textContent = (clipped.length ? "clipped · " : "") + range(s.source, low, high);
}

// Draws the current spectrum at the right, and the spectra of the last seconds at the left; there,
// time runs to the right and frequency upwards.
function drawSpectrum(s, pen, whole, h, ratio) {
  if (!s.spectrum) return;
  const left = Math.round(whole * 0.4);
  drawSpectrogram(s, pen, left - 4 * ratio, h);
  pen.save();
  pen.translate(left, 0);
  drawBands(s, pen, whole - left, h, ratio);
  pen.restore();
}

function drawSpectrogram(s, pen, w, h) {
  const top = s.top ?? -60;
  pen.fillStyle = s.stalled ? colours.idle : colours.traces[0];
  s.columns.forEach((db, i) => {
    const x = w * (COLUMNS - s.columns.length + i) / COLUMNS;
    db.forEach((value, band) => {
      pen.globalAlpha = Math.max(0, Math.min(1, (value - (top - 60)) / 60)) ** 1.5;
      pen.fillRect(x, h * (1 - (band + 1) / db.length), w / COLUMNS + 0.5, h / db.length + 0.5);
    });
  });
  pen.globalAlpha = 1;
}

function drawBands(s, pen, w, h, ratio) {
  const { from_hz, to_hz, db } = s.spectrum;
  const x = (hz) => w * Math.log(hz / from_hz) / Math.log(to_hz / from_hz);
  pen.fillStyle = colours.grid;
  pen.font = `${11 * ratio}px system-ui`;
  for (const hz of TICKS_HZ.filter((hz) => hz > from_hz && hz < to_hz)) {
    pen.fillRect(x(hz), 0, ratio, h);
  }
  // The scale ends 60 dB below the strongest recent band: silence stays empty. Labels are on top.
  const strongest = Math.max(...db, -60);
  s.top = Math.max(strongest, (s.top ?? strongest) - 0.5);
  const y = (value) => h - (h - 17 * ratio) * Math.max(0, value - (s.top - 60)) / 60;
  pen.fillStyle = s.stalled ? colours.idle : colours.traces[0];
  db.forEach((value, band) => {
    const left = w * band / db.length;
    pen.fillRect(left, y(value), Math.max(w / db.length - ratio, ratio), h - y(value));
  });
  pen.fillStyle = colours.soft;
  let free = 0;
  for (const hz of TICKS_HZ.filter((hz) => hz > from_hz && hz < to_hz)) {
    const text = hz < 1000 ? `${hz} Hz` : `${hz / 1000} kHz`;
    const room = w - x(hz) > pen.measureText(text).width + 4 * ratio;
    // Labels must not overlap.
    if (!room || x(hz) < free) continue;
    pen.fillText(text, x(hz) + 3 * ratio, 12 * ratio);
    free = x(hz) + pen.measureText(text).width + 8 * ratio;
  }
  if (!s.stalled) s.note.textContent = `loudest ${Math.round(s.top)} dB`;
}

// The range of values as text. Microphones give shares of full scale, other sources their own unit.
function range(source, low, high) {
  const unit = /^(mi\d|sound)$/.test(source) ? " of full scale" : "";
  // Force and metal must not rest at exactly zero.
  if (low === 0 && high === 0 && !/^(fr|me)$/.test(source)) return "at zero: check the cable";
  if (low === high) return `${short(low)}${unit}`;
  return `${short(low)} to ${short(high)}${unit}`;
}

function short(value) {
  const size = Math.abs(value);
  if (size !== 0 && (size < 0.01 || size >= 100000)) return value.toExponential(1);
  return String(Number(value.toPrecision(3)));
}

readColours();
window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
  readColours();
  show(view);
});
window.addEventListener("resize", () => show(view));
