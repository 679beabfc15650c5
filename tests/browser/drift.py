#!/usr/bin/env python3
"""The dialogue of drift, in headless Chromium: past scans of a reference surface whose level has moved
show as a chart with its limits, and what has drifted comes first.

    tests/browser/drift.py target/release/surfaced [FOLDER FOR SCREENSHOTS]

Needs chromium and chromedriver (Debian: chromium chromium-driver).
"""

from access import assert_named, close, long_names_wrap
from page import on_stage
from review import give_past, shots_of

PART = "golden part"
SCANS, MOVED = 40, 30
# Scans from which a chart learns how the station was.
NEEDED = 25


def level(channel, level_db):
    return {"source": "ac", "channel": channel, "level_db": level_db, "noise_db": None}


def lines(scan, answer):
    """A scan of the part: one channel gets louder by 3 dB, another came only lately."""
    levels = [level(1, -20 + (3 if scan > MOVED else scan % 3 / 10))]
    levels += [level(2, -30.5)] if scan > SCANS - 5 else []
    of = {"state": "named", "surface": PART, "spoiled": [], "p_value": 0.5 + scan % 2 / 10, "levels": levels}
    yield {"answer": {**answer, **of}}


def golden(surfaced, library, data):
    """Makes the part a reference, and gives the library a past of its scans."""
    give_past((surfaced, library, data), SCANS, 3600, lines)
    about = library / "library.toml"
    # No scan that is played now bears its name.
    reference = f'reference = {{ "{PART}" = 2020-01-01T00:00:00Z }}'
    about.write_text(about.read_text().replace("format = 1\n", f"format = 1\n{reference}\n", 1))


CHARTS = """
return [...document.querySelectorAll('#drift figure')].map(figure => {
  const count = what => figure.querySelectorAll(what).length;
  const average = figure.querySelector('.average').getAttribute('points');
  return {
    says: figure.querySelector('figcaption').innerText, label: figure.querySelector('svg').getAttribute('aria-label'),
    loud: count('figcaption b'), limits: count('.limit'), centre: count('.centre'), first: count('circle.first'),
    later: count('circle.later'), average: average ? average.split(' ').length : 0,
  };
});
"""


def check(browser, station, shots):
    browser.open(station.url + "/")
    browser.wait("what has drifted", lambda: "channel 1 is louder" in (browser.text("#drift-now") or ""))
    assert browser.run("return document.getElementById('drift-open').dataset.found") == "true"
    browser.click("#drift-open")
    browser.wait("the charts", lambda: browser.run("return document.querySelectorAll('#drift figure').length") >= 3)
    assert browser.text("#drift h3") == PART
    charts = browser.run(CHARTS)
    first = charts[0]
    assert first["says"].startswith("acceleration 1, level in the drag") and "Drifted: moved by" in first["says"], first
    assert first["label"].startswith("acceleration 1, level in the drag: Drifted"), first
    assert (first["loud"], first["limits"], first["centre"]) == (1, 2, 1), first
    assert (first["first"], first["later"], first["average"]) == (NEEDED, SCANS - NEEDED, SCANS - NEEDED), first
    fit = next(chart for chart in charts if chart["says"].startswith("fit"))
    assert "No drift" in fit["says"] and (fit["loud"], fit["limits"]) == (0, 1), f"fit may only fall: {fit}"
    young = next(chart for chart in charts if chart["says"].startswith("acceleration 2"))
    assert f"Not yet known: 5 scans; it takes {NEEDED + 1}." in young["says"], young
    assert (young["limits"], young["centre"], young["average"]) == (0, 0, 0), young
    shots_of(browser, shots, "drift")
    long_names_wrap(browser, "drift")
    browser.accessible("drift")
    assert_named(browser, "drift", 5)
    close(browser, "drift")
    browser.wait("the focus back", lambda: browser.run("return document.activeElement.id") == "drift-open")
    # A link to it opens it, too.
    browser.open(station.url + "/#drift")
    browser.wait("the dialogue", lambda: browser.run("return document.getElementById('drift').open"))
    console = browser.log("browser")
    assert not console, f"the console stays empty: {console}"


def main():
    on_stage(check, golden, trials="10", users="0", kept=3, seconds="1.0")
    print("drift is seen, with its limits")


if __name__ == "__main__":
    main()
