"""Measures how smoothly the page of `densify view` moves, in a real browser: a benchmark, not a test.

    python pace.py DENSIFY RUN [ROUNDS]          needs chromium and chromium-driver

The stage is 640x480. In each round the scene is turned for four seconds, a little with every frame of the screen, and
then left alone. Said are the pictures that were shown in a second, the rate that the page reports, the sizes that were
shown, and how long after the last movement the picture was as sharp as it gets. For a model of 30,000 Gaussians:

    densify train scene:room -o RUN --budget 30k --init random --init-points 30k --iterations 600 --eval
"""

import sys
from statistics import mean, median

from view import TURN, Browser, served

SECONDS = 4


def measure(browser: Browser, url: str, rounds: int) -> None:
    browser.size(640, 480)
    browser.open(url)
    browser.is_sharp()
    browser.press("\ue007")
    browser.run("document.getElementById('fold').click(); goHome(); leaveView(); changed();")
    browser.is_sharp()
    rows = browser.run("return scene.models[0].rows")
    shown = browser.run("return document.getElementById('stage').dataset.size")
    print(f"{rows} Gaussians, {shown} at rest")
    found = []
    for number in range(rounds):
        turned = browser.wait(TURN, SECONDS)
        browser.is_sharp()
        rested, drawn = browser.run(
            "return [Number(stage.dataset.rested), document.getElementById('status').textContent]"
        )
        found.append((turned["rate"], turned["said"], mean(turned["sides"]), rested))
        rate, said, side, rested = found[-1]
        print(f"round {number}: {rate:.1f} pictures/s (the page says {said:.1f}), {side:.0f} px wide on average; "
              f"sharp {rested:.0f} ms after the last movement ({drawn})")
    rate, said, side, rested = (median(column) for column in zip(*found))
    print(f"median: {rate:.1f} pictures/s (the page says {said:.1f}), {side:.0f} px wide, sharp after {rested:.0f} ms")


def main(densify: str, run: str, rounds: str = "5") -> None:
    with served(densify, run) as (browser, url):
        measure(browser, url, int(rounds))


if __name__ == "__main__":
    main(*sys.argv[1:])
