#!/usr/bin/env python3
"""Enrolment that cannot mislabel, in headless Chromium: a trial that looks like another surface is
said to, and is confirmed or taken back there.

    tests/browser/enrol.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver).
"""

from page import on_stage
from review import get, shots_of

# Seconds that each synthetic scan lasts.
DRAG = "1.5"
LIKE = "This looks like slate, which you have."


def enrol(browser, surface, trials):
    """Orders trials of a surface by the form, and waits until they are kept; the newest stands first.
    A scan with a flaw is refused, and the next one is taken."""
    browser.run("document.getElementById('trials').value = arguments[0]", str(trials))
    browser.type("#surface", surface)
    browser.click("#enroll")
    browser.wait(f"{trials} to come", lambda: surface in (browser.text("#enrolling-what") or ""))
    kept = "return [...document.querySelectorAll('#enrolled li')].filter(li => li.innerText.includes(arguments[0])).length"
    browser.wait("the trials", lambda: browser.run(kept, f" kept as {surface}, trial ") >= trials)


def press(browser, text):
    """Presses the first button under the enrolment that begins like this."""
    found = browser.run(
        "const b = [...document.querySelectorAll('#enrolled button')].find(b => b.innerText.startsWith(arguments[0]));"
        "b?.click(); return Boolean(b)", text)
    assert found, f"no button {text!r} in {browser.text('#enrolled')!r}"


def known(browser, surface):
    return lambda: surface in (browser.text("#surfaces") or "")


def check(browser, station, shots):
    browser.open(station.url + "/")
    browser.wait("the form", lambda: browser.run("return document.getElementById('surface').offsetParent !== null"))

    # A new surface, which looks like none of the library's.
    enrol(browser, "slate", 3)
    assert "This looks like" not in browser.text("#enrolled"), browser.text("#enrolled")
    assert "the library in use has no slate yet" in browser.text("#enrolled li"), browser.text("#enrolled li")
    browser.wait("the library with slate", known(browser, "slate"))
    browser.wait("how it is named left out", lambda: "of 3 trials of slate are named right" in (browser.text("#enrolled-rest") or ""))

    # More of it: the library says what it knew before. A count is shown once it rests on three trials.
    browser.run("document.getElementById('trials').value = 40")
    browser.type("#surface", "slate")
    browser.click("#enroll")
    browser.wait("a trial that was named", lambda: "before it was added, the library named it slate, at " in browser.text("#enrolled li"))
    assert "were named right" not in browser.text("#enrolling-kept"), browser.text("#enrolling-kept")
    assert not browser.text("#enrolled-rest"), "the library is not read with them yet"
    browser.wait("how many were named right", lambda: "of 3 were named right before they were added" in browser.text("#enrolling-kept"))
    shots_of(browser, shots, "added")
    browser.click("#enroll-end")
    browser.wait("the end of the order", lambda: browser.run("return document.getElementById('enrolling').hidden"))

    # The same surface under another name: it looks like slate, which is in the library.
    enrol(browser, "granite", 1)
    asked = browser.text("#enrolled li")
    assert LIKE in asked and "Is it granite?" in asked, asked
    shots_of(browser, shots, "enrol")
    press(browser, "No, take it back")
    browser.wait("the trial taken back", lambda: "taken back" in browser.text("#enrolled li"))
    names = lambda key: [trial["trial"] for trial in get(station, "/api/v1/library/trials")[key]]
    assert not any(name.startswith("granite/") for name in names("trials")), names("trials")
    assert any(name.startswith("granite/") for name in names("removed")), "it can come back"
    browser.wait("the library without granite", lambda: not known(browser, "granite")())

    # Said to be right all the same, it stays, and is not asked about again.
    enrol(browser, "basalt", 1)
    browser.wait("the question", lambda: LIKE in browser.text("#enrolled li"))
    press(browser, "Yes, basalt")
    browser.wait("no question", lambda: LIKE not in browser.text("#enrolled li"))
    assert any(name.startswith("basalt/") for name in names("trials")), names("trials")
    # A trial that was kept rightly can be taken back just so.
    press(browser, "Undo")
    browser.wait("the undo", lambda: not any(name.startswith("basalt/") for name in names("trials")))
    # Nobody's order is replaced unseen.
    browser.run("document.getElementById('trials').value = 40")
    browser.type("#surface", "quartz")
    browser.click("#enroll")
    browser.wait("the order", lambda: "quartz" in (browser.text("#enrolling-what") or ""))
    browser.type("#surface", "marble")
    browser.click("#enroll")
    browser.wait("whose order stands", lambda: "enrols quartz now" in (browser.text("#enroll-who") or ""))
    shots_of(browser, shots, "standing")
    browser.click("#enroll-instead")
    browser.wait("the new order", lambda: "marble" in (browser.text("#enrolling-what") or ""))
    browser.click("#enroll-end")
    console = browser.log("browser")
    assert not console, f"the console stays empty: {console}"


def main():
    on_stage(check, lambda *_: None, trials="40", users="0", kept=6, seconds=DRAG)
    print("no trial is mislabelled unseen")


if __name__ == "__main__":
    main()
