"""Measures how smoothly the page of `densify view` moves, in a real browser: a benchmark, not a test.

    python pace.py DENSIFY RUN [ROUNDS]          needs chromium and chromium-driver

The stage is 640x480. In each round the scene is turned for four seconds, a little with every frame of the screen, and
then left at rest. The output is the number of pictures shown per second, the rate that the page reports, the mean width
of the pictures, and the time from the last movement to a picture of full resolution. For a model of 30,000 Gaussians:

    densify train scene:room -o RUN --budget 30k --init random --init-points 30k --iterations 600 --eval
"""

import sys
from statistics import mean, median

from view import TURN, Browser, served

SECONDS = 4


def measure(browser: Browser, url: str, rounds: int) -> None:
    browser.size(640, 480)
    browser.open(url)
    browser.wait_until_sharp()
    browser.press("\ue007")  # Enter closes the help
    browser.run("document.getElementById('fold').click(); goHome(); leaveView(); changed();")
    browser.wait_until_sharp()
    rows = browser.run("return scene.models[0].rows")
    shown = browser.run("return document.getElementById('stage').dataset.size")
    print(f"{rows} Gaussians, {shown} at rest")
    results = []
    for number in range(rounds):
        turned = browser.run_async(TURN, SECONDS)
        browser.wait_until_sharp()
        sharp_after, status = browser.run(
            "return [Number(stage.dataset.rested), document.getElementById('status').textContent]"
        )
        results.append((turned["rate"], turned["reported"], mean(turned["widths"]), sharp_after))
        rate, reported, width, sharp_after = results[-1]
        print(f"round {number}: {rate:.1f} pictures/s (the page reports {reported:.1f}), {width:.0f} px wide on average; "
              f"sharp {sharp_after:.0f} ms after the last movement ({status})")
    rate, reported, width, sharp_after = (median(column) for column in zip(*results))
    print(f"median: {rate:.1f} pictures/s (the page reports {reported:.1f}), {width:.0f} px wide, sharp after {sharp_after:.0f} ms")


def main(densify: str, run: str, rounds: str = "5") -> None:
    with served(densify, run) as (browser, url):
        measure(browser, url, int(rounds))


if __name__ == "__main__":
    main(*sys.argv[1:])
