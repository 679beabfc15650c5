#!/usr/bin/env python3
"""Persons and roles in headless Chromium: a name once a shift, many scans corrected at once and undone,
the list of changes, and what an operator's page leaves out.

    tests/browser/people.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver).
"""

import json
import os
import sys
import tempfile
import urllib.request
from pathlib import Path

from access import long_names_wrap
from page import ENTER, Station, requests, scene
from review import shots_of
from webdriver import Browser

# Seconds that each synthetic scan lasts.
DRAG = "1.5"
ADMINISTRATOR, OPERATOR = "administrator-of-a-day", "operator-of-a-day-16"
PERSON = "Jürgen Müller-Wiesengrund"


def get(station, path, token=ADMINISTRATOR):
    request = urllib.request.Request(station.url + path, headers={"Authorization": f"Bearer {token}"})
    with urllib.request.urlopen(request, timeout=20) as answer:
        return answer.read().decode()


def scan(station, name):
    return json.loads(get(station, f"/api/v1/scans/{name}"))


def seen(browser, name):
    return browser.run("return document.getElementById(arguments[0]).checkVisibility()", name)


def rows(browser):
    return browser.run("return [...document.querySelectorAll('#scans tr')].map(r => r.dataset.id)")


def a_name_is_asked_once_a_shift(browser, station, shots):
    browser.open(f"{station.url}/?token={ADMINISTRATOR}")
    browser.wait("the role", lambda: browser.run("return document.body.dataset.role") == "administrator")
    assert seen(browser, "person-form") and not seen(browser, "person-known")
    browser.wait("scans, which do not wait for a name", lambda: len(rows(browser)) >= 3)
    shots_of(browser, shots, "person")
    browser.type("#person-name", PERSON + ENTER)
    browser.wait("the name", lambda: PERSON in (browser.text("#person-known") or ""))
    assert browser.run("return document.activeElement.id") == "person-change", "the focus is not lost"
    browser.open(station.url + "/")
    browser.wait("the name, remembered", lambda: PERSON in (browser.text("#person-known") or ""))
    # Ten hours later it is asked again.
    browser.run("const held = JSON.parse(localStorage.getItem('surfaced-person')); held.until = Date.now() - 1;"
                "localStorage.setItem('surfaced-person', JSON.stringify(held))")
    browser.open(station.url + "/")
    browser.wait("the name, asked anew in a new shift", lambda: seen(browser, "person-form"))
    browser.type("#person-name", PERSON + ENTER)
    browser.click("#person-change")
    assert browser.run("return document.activeElement.id") == "person-name"
    browser.keys(ENTER)
    browser.wait("the same name", lambda: seen(browser, "person-known"))


def many_are_corrected_and_undone(browser, station, shots):
    browser.wait("scans", lambda: len(rows(browser)) >= 3)
    browser.click("#select-open")
    chosen = rows(browser)[:3]
    for one in chosen:
        focus = ("const box = document.querySelector(`#scans tr[data-id='${arguments[0]}'] input`);"
                 "box?.focus(); return box !== null")
        browser.wait("a box beside the scan", lambda: browser.run(focus, one))
        browser.keys(" ")
    assert browser.text("#selected") == "3 scans selected", browser.text("#selected")
    shots_of(browser, shots, "select")
    long_names_wrap(browser, "selected scans")
    browser.accessible("selected scans")
    requests(browser)
    browser.type("#all-were", "slate" + ENTER)
    browser.wait("what was done", lambda: browser.text("#select-done") == "Corrected 3 scans.")
    was = [scan(station, one)["correction"] for one in chosen]
    assert all(c == {"was": "surface", "surface": "slate", "person": PERSON} for c in was), was
    badges = "return [...document.querySelectorAll('#scans .badge')].filter(b => b.innerText === 'it was slate').length"
    browser.wait("the badges", lambda: browser.run(badges) == 3)
    browser.wait("the precision", lambda: "of 3" in browser.text("#precision-sum"))
    asked = [url for url in requests(browser) if url.endswith("/api/v1/history")]
    assert len(asked) <= 2, f"one request for many corrections: {asked}"
    browser.click("#select-undo")
    browser.wait("the undoing", lambda: browser.text("#select-done") == "Undone for 3 scans.")
    assert all(scan(station, one)["correction"] is None for one in chosen)
    browser.wait("nothing more to undo", lambda: not seen(browser, "select-undo"))
    browser.click("#select-open")
    browser.wait("no selection", lambda: not seen(browser, "select-bar"))


def changes_are_listed(browser, station, shots):
    browser.run("document.getElementById('changes-open').focus()")
    browser.keys(ENTER)
    lines = lambda: browser.run("return [...document.querySelectorAll('#changes-list li')].map(li => li.innerText)")
    browser.wait("the changes", lambda: len(lines()) == 6)
    newest, first = lines()[0], lines()[-1]
    assert PERSON in newest and "slate → not reviewed" in newest, newest
    assert PERSON in first and "not reviewed → slate" in first, first
    shots_of(browser, shots, "changes")
    long_names_wrap(browser, "changes")
    browser.accessible("changes")
    href = browser.run("return document.getElementById('changes-export').href")
    exported = [json.loads(line) for line in get(station, href.removeprefix(station.url)).splitlines()]
    assert len(exported) == 6 and all(one["person"] == PERSON for one in exported), exported
    # A scan is opened from there, and closing it leads back.
    subject = browser.text("#changes-list button")
    browser.run("document.querySelector('#changes-list button').click()")
    browser.wait("the scan", lambda: browser.run("return document.getElementById('scan').open"))
    assert browser.run("return location.hash") == f"#scan={subject}"
    browser.keys("\ue00c")
    browser.wait("the changes again", lambda: browser.run("return document.getElementById('changes').open"))
    browser.keys("\ue00c")
    browser.wait("the page", lambda: not browser.run("return document.getElementById('changes').open"))


def an_operator_is_offered_what_is_allowed(browser, station, shots):
    browser.run("localStorage.clear()")
    # A page that is still open would ask for the next picture without its cookie.
    browser.open("about:blank")
    browser.devtools("Network.clearBrowserCookies")
    browser.open(f"{station.url}/?token={OPERATOR}")
    browser.wait("the role", lambda: browser.run("return document.body.dataset.role") == "operator")
    # A request of the page before may have lost its cookie on its way.
    assert all(" 401 " in entry["message"] for entry in browser.log("browser")), "the console stays empty"
    for name in ("start", "stop", "select-open", "shelf-open", "person-form"):
        assert seen(browser, name), name
    for name in ("enroll-form", "reload", "changes-open"):
        assert not seen(browser, name), name
    browser.click("#person-skip")
    browser.wait("skipped", lambda: "without a name" in (browser.text("#person-known") or ""))
    browser.wait("scans", lambda: len(rows(browser)) >= 1)
    shots_of(browser, shots, "operator")
    one = rows(browser)[0]
    browser.run("document.querySelector(`#scans tr[data-id='${arguments[0]}'] button`).click()", one)
    browser.wait("the scan", lambda: browser.run("return document.getElementById('scan').open"))
    browser.type("#was", "slate" + ENTER)
    browser.wait("the correction", lambda: "it was slate" in (browser.text("#was-now") or ""))
    assert scan(station, one)["correction"]["person"] is None
    assert not seen(browser, "keep-form")
    browser.keys("\ue00c")
    browser.wait("the page", lambda: not browser.run("return document.getElementById('scan').open"))
    browser.open_library()
    browser.wait("the trials", lambda: browser.run("return document.querySelectorAll('#shelf-trials tbody tr').length > 4"))
    assert not seen(browser, "check") and not browser.run("return document.querySelector('.acts button').checkVisibility()")
    browser.accessible("an operator's library")


def main():
    surfaced, shots = sys.argv[1], sys.argv[2] if len(sys.argv) > 2 else None
    with tempfile.TemporaryDirectory() as folder, Browser() as browser:
        library, data = scene(surfaced, Path(folder), trials="40", users="0", seconds=DRAG)
        os.environ |= {"SURFACED_TOKEN": ADMINISTRATOR, "SURFACED_OPERATOR_TOKEN": OPERATOR}
        station = Station(surfaced, library, data)
        try:
            a_name_is_asked_once_a_shift(browser, station, shots)
            many_are_corrected_and_undone(browser, station, shots)
            changes_are_listed(browser, station, shots)
            an_operator_is_offered_what_is_allowed(browser, station, shots)
            console = browser.log("browser")
            assert not console, f"the console stays empty: {console}"
        finally:
            station.end()
    print("persons and roles are known")


if __name__ == "__main__":
    main()
