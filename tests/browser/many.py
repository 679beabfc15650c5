#!/usr/bin/env python3
"""Ten thousand past scans, in headless Chromium: how long the page takes to open, and that the
memory of the station does not grow with use.

    tests/browser/many.py target/release/surfaced

Needs chromium and chromedriver (Debian: chromium chromium-driver).
"""

import time
import urllib.request
from pathlib import Path

from page import on_stage
from review import get, give_past

SCANS = 10_000
# Rows that the page shows at first.
ROWS = 300


def lines(scan, answer):
    """An answer, corrected now and then."""
    yield {"answer": answer}
    if scan % 10 == 0:
        was = {"was": "surface", "surface": answer["ranked"][scan // 10 % 2]["surface"]}
        yield {"correction": {"id": answer["id"], "correction": was}}


def resident_mb(station):
    status = Path(f"/proc/{station.process.pid}/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1024


def timed(act):
    begin = time.monotonic()
    act()
    return time.monotonic() - begin


def opened(browser, station):
    """Seconds from the address to the rows of the history."""
    browser.open("about:blank")
    # No person opens it so often that requests are refused.
    time.sleep(0.6)

    def act():
        browser.open(station.url + "/")
        browser.wait("the rows", lambda: browser.run("return document.querySelectorAll('#scans tr').length") >= ROWS)

    return timed(act)


def use(browser, station):
    """What an operator and a program do all day."""
    opened(browser, station)
    get(station, "/api/v1/history")
    for path in ("/api/v1/scans.csv", "/api/v1/scans.jsonl"):
        with urllib.request.urlopen(station.url + path, timeout=60) as answer:
            assert len(answer.read().splitlines()) >= SCANS


def older_ones(browser):
    """The page shows older scans on demand."""
    browser.click("#older")
    rows = "return [...document.querySelectorAll('#scans tr')].map(r => r.dataset.id)"
    names = browser.wait("older rows", lambda: len(shown := browser.run(rows)) >= 2 * ROWS and shown)
    assert len(set(names)) == len(names), "no scan twice"
    # Names begin with their moment.
    assert names == sorted(names, reverse=True), "the newest first"


def check(browser, station, _shots):
    assert get(station, "/api/v1/history")["scans"] >= SCANS
    answer_s = min(timed(lambda: get(station, f"/api/v1/scans?limit={ROWS}")) for _ in range(5))
    page_s = min(opened(browser, station) for _ in range(5))
    older_ones(browser)
    # The first uses fill what stays: buffers, the allocator's pages.
    for _ in range(3):
        use(browser, station)
    before = resident_mb(station)
    for _ in range(12):
        use(browser, station)
    after = resident_mb(station)
    print(f"{SCANS} scans: the first {ROWS} in {answer_s * 1e3:.0f} ms, the page in {page_s * 1e3:.0f} ms, "
          f"{before:.0f} MB before and {after:.0f} MB after twelve more uses")
    assert after < before + 16, f"memory grows from {before:.0f} to {after:.0f} MB"


def main():
    on_stage(check, lambda *stage: give_past(stage, SCANS, 60, lines), trials="10", users="0", kept=3, seconds="1.0")
    print("a long history opens, and takes no memory with use")


if __name__ == "__main__":
    main()
