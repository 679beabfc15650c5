// The cameras: the newest picture of each, the region of it that is compared, and the light.

import { make, plain, sourceName } from "./dom.js";

// A camera is shown as stalled after this long without a picture; some cameras are slow.
const STALLED_MS = 3500;
// The shortest time between two pictures: at most two a second are shown.
const LEAST_MS = 500;
// A picture that has not come after this long never comes: the network swallowed the request.
const GIVEN_UP_MS = 15_000;
const cameras = new Map();
// The station's own camera: its source, the compared region, its light. Null if there is none.
let own = null;

function box(place, source) {
  place.querySelector(".empty")?.remove();
  const figure = make("figure", undefined, "plot camera");
  const head = make("div");
  const note = make("span");
  const light = make("span", undefined, "light");
  head.append(sourceName(source), note, light);
  const view = make("div", undefined, "view");
  const image = make("img");
  image.alt = `what the camera sees, ${plain(source)}`;
  figure.dataset.source = source;
  const region = make("i", undefined, "region");
  view.append(image, region);
  figure.append(head, view);
  place.append(figure);
  const camera = { source, figure, image, note, light, region, busy: false, asked: 0, arrived: performance.now() };
  image.addEventListener("load", () => {
    camera.busy = false;
    figure.dataset.seen = "true";
  });
  image.addEventListener("error", () => (camera.busy = false));
  cameras.set(source, camera);
  return camera;
}

const share = (part) => `${(part * 100).toFixed(2)}%`;

// Whether the whole picture is shown because only a region of it is compared.
const isWhole = (camera) => own?.source === camera.source && own.region !== null;

function describe(camera) {
  const whole = isWhole(camera);
  const { left, top, width, height } = whole ? own.region : { left: 0, top: 0, width: 1, height: 1 };
  camera.figure.dataset.whole = String(whole);
  Object.assign(camera.region.style, { left: share(left), top: share(top), width: share(width), height: share(height) });
  const all = width > 0.999 && height > 0.999;
  camera.note.textContent = all ? "all of it is compared" : "what is inside the frame is compared";
  const flash = own?.source === camera.source ? own.flash : "none";
  camera.light.textContent = { on: "flash on", off: "flash off", failed: "the flash cannot be switched" }[flash] ?? "";
  camera.light.dataset.flash = flash;
}

// Called when a camera has a new picture. Shows at most two pictures a second, and loads each only
// after the previous one.
export function picture(place, source) {
  const camera = cameras.get(source) ?? box(place, source);
  camera.arrived = performance.now();
  delete camera.figure.dataset.stalled;
  describe(camera);
  const least_ms = camera.busy ? GIVEN_UP_MS : LEAST_MS;
  if (camera.arrived - camera.asked < least_ms || document.hidden) return;
  [camera.busy, camera.asked] = [true, camera.arrived];
  camera.image.src = `api/v1/pictures/${isWhole(camera) ? "whole-" : ""}${source}.jpg?at=${Math.round(camera.arrived)}`;
}

// Sets the view of the station's own camera; null if it has none.
export function view(camera) {
  own = camera;
  const shown = own && cameras.get(own.source);
  if (shown && !shown.figure.dataset.stalled) describe(shown);
}

setInterval(() => {
  for (const camera of cameras.values()) {
    const silent_ms = performance.now() - camera.arrived;
    if (silent_ms < STALLED_MS) continue;
    camera.figure.dataset.stalled = "true";
    camera.note.textContent = `no picture for ${(silent_ms / 1000).toFixed(0)} s`;
  }
}, 1000);
