// Enrolment: how many trials have been kept, the newest ones and what they added, and the last refusal.

import { $, ask, button, hide, make, many, percent, plainLine, printable, say } from "./dom.js";

// How many trials a count must rest on to be shown.
const ENOUGH = 3;
let newest = [];
// The order that stands, whoever gave it.
let standing = null;

// Handles a scan that was kept or refused.
export const add = (enrolled) => (newest = [enrolled, ...newest].slice(0, 3));

// The answer of the library in use to a trial before it was added, if it gave one.
function before({ surface, nearest, probability, known }) {
  if (known === null) return [];
  if (known === 0) return [`the library in use has no ${surface} yet, so it could not name it`];
  const sure = probability === null ? "" : `, at ${percent(probability)}`;
  return [nearest ? `before it was added, the library named it ${nearest}${sure}` : "before it was added, the library called it unknown"];
}

// How the surface of the newest trial is named now, once the library was read with it.
function showRest({ enrolling, reading, library }) {
  const last = newest.find(({ trial, undone }) => trial !== null && !undone);
  const found = library?.left_out?.find(({ surface }) => surface === last?.surface);
  const isKnown = !enrolling && !reading && found?.trials >= ENOUGH;
  hide("enrolled-rest", !isKnown);
  say("enrolled-rest", isKnown ? `Left out of the library, ${found.right} of ${many(found.trials, "trial")} of ${found.surface} are named right.` : "");
}

export function show(state) {
  const { enrolling, enrolls } = state;
  standing = enrolling;
  if (!enrolling) hide("enroll-standing", true);
  hide("enroll-form", !enrolls);
  hide("no-enroll", enrolls);
  hide("enrolling", !enrolling);
  if (enrolling) {
    const { surface, trials, kept, asked, right, refused, ordered_by } = enrolling;
    const rightly = asked >= ENOUGH ? `; ${right} of ${asked} were named right before they were added` : "";
    say("enrolling-what", `${surface}${ordered_by ? `, ordered by ${ordered_by}` : ""}: `);
    say("enrolling-kept", (trials === null ? `${many(kept, "trial")} kept, until the end` : `${kept} of ${trials} kept`) + rightly);
    hide("enrolling-refused", !refused);
    hide("enroll-keep", !refused);
    say("enrolling-refused", refused ? `Last one refused: ${refused.reasons.map(plainLine).join(" · ")}` : "");
    $("enroll-keep").dataset.scan = refused?.scan ?? "";
  }
  showNewest();
  showRest(state);
}

// Shows the newest scans; a kept trial can be removed again.
function showNewest() {
  const text = JSON.stringify(newest);
  if ($("enrolled").dataset.text === text) return;
  $("enrolled").dataset.text = text;
  $("enrolled").replaceChildren(...newest.map((e) => {
    const kept = e.trial === null ? `scan ${e.scan} was not kept as ${e.surface}` : `scan ${e.scan} kept as ${e.surface}, trial ${e.trial}`;
    const item = make("li", [kept, ...before(e), ...e.remarks.map(plainLine)].join(" · "));
    const looksLike = e.nearest && e.nearest !== e.surface && !e.undone && !e.confirmed;
    if (looksLike) {
      item.append(make("p", `This looks like ${e.nearest}, which you have. Is it ${e.surface}?`, "warn"));
      item.append(button(`Yes, ${e.surface}`, () => {
        e.confirmed = true;
        showNewest();
      }, "small"));
    }
    if (e.undone) item.append(make("span", "taken back", "badge"));
    else if (e.folder) {
      const name = e.folder.split("/").slice(-2).join("/");
      const back = button(looksLike ? "No, take it back" : "Undo", async () => {
        if (!(await ask("library/remove", { trials: [name] }))) return;
        e.undone = true;
        showNewest();
      }, "small administrator");
      back.setAttribute("aria-label", printable(`take back ${name}`));
      item.append(back);
    }
    return item;
  }));
}

$("enroll-end").addEventListener("click", () => ask("enroll/end", {}));
$("enroll-keep").addEventListener("click", ({ currentTarget }) => ask("enroll/keep", { scan: Number(currentTarget.dataset.scan) }));
// Another order is replaced only by somebody who has seen whose it is.
async function order(replace) {
  const body = { surface: $("surface").value, user: $("user").value, trials: Number($("trials").value), replace };
  if (!(await ask("enroll", body))) return;
  $("surface").value = "";
  hide("enroll-standing", true);
}

$("enroll-instead").addEventListener("click", () => $("enroll-form").reportValidity() && order(true));
$("enroll-form").addEventListener("submit", (event) => {
  event.preventDefault();
  if (!standing) return order(false);
  const { ordered_by, user, surface, kept, trials } = standing;
  const sofar = trials === null ? `${many(kept, "trial")} kept` : `${kept} of ${trials} kept`;
  say("enroll-who", `${ordered_by ?? user} enrols ${surface} now: ${sofar}. `);
  hide("enroll-standing", false);
});
