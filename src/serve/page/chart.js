// Draws a whole scan together with the nearest trial of the library: their traces, and their
// spectra.

import { make } from "./dom.js";

const WIDTH = 640;
const HEIGHT = 120;

function colours() {
  const style = getComputedStyle(document.documentElement);
  const of = (name) => style.getPropertyValue(name).trim();
  return { own: of("--trace-0"), nearest: of("--trace-1"), grid: of("--grid"), soft: of("--soft") };
}

function canvas(label, draw) {
  const element = make("canvas", undefined, "chart");
  element.setAttribute("role", "img");
  element.setAttribute("aria-label", label);
  [element.width, element.height] = [WIDTH * 2, HEIGHT * 2];
  const pen = element.getContext("2d");
  pen.scale(2, 2);
  draw(pen, colours());
  return element;
}

function extent(views, channel) {
  let [low, high] = [Infinity, -Infinity];
  for (const view of views) {
    if (!view?.min[channel]) continue;
    low = Math.min(low, ...view.min[channel]);
    high = Math.max(high, ...view.max[channel]);
  }
  const flat = Math.max(high - low, 1e-9);
  return [low - flat * 0.05, high + flat * 0.05];
}

function band(pen, view, channel, [left, right], y) {
  const [min, max] = [view.min[channel], view.max[channel]];
  const x = (i) => left + ((right - left) * (i + 0.5)) / min.length;
  pen.beginPath();
  max.forEach((value, i) => (i === 0 ? pen.moveTo(x(i), y(value)) : pen.lineTo(x(i), y(value))));
  for (let i = min.length - 1; i >= 0; i--) pen.lineTo(x(i), y(min[i]));
  pen.closePath();
  pen.fill();
  pen.stroke();
}

// Draws each channel in a separate lane. Scan and trial share the scales of time and value.
export function traces(source, own, nearest) {
  const views = [own, nearest].filter(Boolean);
  const seconds = Math.max(...views.map((view) => view.duration_s));
  return canvas(`signal of ${source}, this scan and the nearest trial`, (pen, colour) => {
    const channels = own.min.length;
    const lane = HEIGHT / channels;
    pen.lineWidth = 0.7;
    for (let channel = 0; channel < channels; channel++) {
      const [low, high] = extent(views, channel);
      const y = (value) => lane * channel + lane * (1 - (value - low) / (high - low));
      for (const [view, name] of [[nearest, "nearest"], [own, "own"]]) {
        if (!view?.min[channel]) continue;
        pen.globalAlpha = name === "own" ? 0.85 : 0.6;
        pen.fillStyle = pen.strokeStyle = colour[name];
        band(pen, view, channel, [0, (WIDTH * view.duration_s) / seconds], y);
      }
      pen.globalAlpha = 1;
      pen.fillStyle = colour.grid;
      if (channel > 0) pen.fillRect(0, lane * channel, WIDTH, 1);
    }
    pen.fillStyle = colour.soft;
    pen.font = "11px system-ui";
    pen.textAlign = "right";
    pen.fillText(`${seconds.toFixed(1)} s`, WIDTH - 3, HEIGHT - 4);
  });
}

// Draws spectra as lines, down to 60 dB below the strongest band.
export function spectra(source, own, nearest) {
  const lines = [[nearest?.spectrum, "nearest"], [own.spectrum, "own"]].filter(([line]) => line);
  const top = Math.max(-60, ...lines.flatMap(([line]) => line.db));
  return canvas(`spectrum of ${source}, this scan and the nearest trial`, (pen, colour) => {
    const { from_hz, to_hz } = own.spectrum;
    const x = (hz) => (WIDTH * Math.log(hz / from_hz)) / Math.log(to_hz / from_hz);
    pen.font = "11px system-ui";
    for (const hz of [10, 100, 1000, 10000].filter((hz) => hz > from_hz && hz < to_hz)) {
      pen.fillStyle = colour.grid;
      pen.fillRect(x(hz), 0, 1, HEIGHT);
      pen.fillStyle = colour.soft;
      pen.fillText(hz < 1000 ? `${hz} Hz` : `${hz / 1000} kHz`, x(hz) + 3, HEIGHT - 4);
    }
    pen.lineWidth = 1.6;
    for (const [line, name] of lines) {
      pen.strokeStyle = colour[name];
      pen.beginPath();
      line.db.forEach((db, i) => {
        const hz = line.from_hz * (line.to_hz / line.from_hz) ** ((i + 0.5) / line.db.length);
        const y = 4 + (HEIGHT - 8) * Math.min(1, (top - db) / 60);
        if (i === 0) pen.moveTo(x(hz), y);
        else pen.lineTo(x(hz), y);
      });
      pen.stroke();
    }
  });
}
