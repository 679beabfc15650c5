// Whether the program behind a page is heard, since when it is not, and what its clock says.

import { clock } from "./dom.js";

// The page is disconnected after this long without a byte. Something comes at least once a second.
const SILENT_MS = 2500;
const CHECK_EVERY_MS = 200;
let heardAt = performance.now();
let heardUnixMs = Date.now();
// Milliseconds by which the clock of this machine is ahead of the program's.
let ahead = 0;

// The time by the program's clock.
export const now = () => Date.now() - ahead;

// Notes that the program was heard; `unixMs` is its clock, if it said so.
export function heard(unixMs) {
  [heardAt, heardUnixMs] = [performance.now(), Date.now()];
  if (unixMs !== undefined) ahead = heardUnixMs - unixMs;
}

export const isLost = () => performance.now() - heardAt > SILENT_MS;

// "Not connected since 10:42", by the program's clock.
export const lostText = () => `Not connected since ${clock(heardUnixMs - ahead).slice(0, 5)}`;

// Runs `changed` whenever the program falls silent or is heard again.
export function watch(changed) {
  let lost = false;
  setInterval(() => {
    if (lost === isLost()) return;
    lost = !lost;
    document.body.dataset.link = lost ? "lost" : "connected";
    changed(lost);
  }, CHECK_EVERY_MS);
}
