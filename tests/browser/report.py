"""Tests reports of `densify report` in a real browser, from file://: nothing is fetched, and the sliders work.

    python report.py FILE [FOLDER FOR SCREENSHOTS]          needs chromium and chromium-driver
"""

import json
import sys
from pathlib import Path

from view import Browser

# The visible images of a stack: their texts, whether they have pixels, and how they are clipped.
SHOWN = """
const figure = document.querySelector(arguments[0]);
const shown = [...figure.querySelectorAll(".stack img")].filter((it) => getComputedStyle(it).display !== "none");
return shown.map((it) => `${it.alt}|${it.naturalWidth > 0}|${getComputedStyle(it).clipPath}`);
"""


def check(browser: Browser, report: Path, folder: Path | None) -> None:
    def scroll_to(selector: str) -> None:
        browser.run("document.querySelectorAll(arguments[0])[0].scrollIntoView()", selector)

    def shown(selector: str) -> list[str]:
        return browser.run(SHOWN, selector)

    browser.size(1280, 800)
    browser.theme("light")
    url = report.resolve().as_uri()
    browser.open(url)
    broken = browser.run("return [...document.images].filter((it) => !it.complete || it.naturalWidth === 0).length")
    assert broken == 0, f"{broken} pictures cannot be shown"
    browser.screenshot(folder, "report")

    # Photograph on the left, render on the right; the border between them moves by keyboard and mouse.
    scroll_to(".pair")
    browser.screenshot(folder, "report-views")
    left, right = shown(".pair")
    assert "photograph|true|none" in left and "50%" in right, f"{left} {right}"
    browser.run("document.querySelector('.pair input').focus()")
    browser.press("\ue010")  # End
    assert "100%" in shown(".pair")[1], "End does not move the border"
    browser.press("\ue011")  # Home
    assert shown(".pair")[1].endswith("inset(0px 0px 0px 0%)"), f"Home does not move the border: {shown('.pair')}"
    browser.run("document.querySelector('.pair .stack').scrollIntoView({ block: 'center' })")
    box = "const b = document.querySelector('.pair .stack').getBoundingClientRect(); return [b.left, b.top, b.width, b.height]"
    x, y, width, height = browser.run(box)
    press = {"type": "pointerMove", "duration": 0, "origin": "viewport", "x": round(x + 0.2 * width), "y": round(y + height / 2)}
    drag = {**press, "x": round(x + 0.75 * width)}
    browser.mouse(press, {"type": "pointerDown", "button": 0}, drag, {"type": "pointerUp", "button": 0})
    value = float(browser.run("return document.querySelector('.pair input').value"))
    assert 73 <= value <= 77, f"dragging moves the border to {value} %"
    # With several runs, any two can be compared.
    if browser.run("return document.querySelector('.pair select') !== null"):
        choose = "const it = document.querySelector('.pair select.left'); it.value = '2';"
        browser.run(choose + "it.dispatchEvent(new Event('change', { bubbles: true }))")
        names = [it.split("|")[0] for it in shown(".pair")]
        assert len(names) == 2 and not any("photograph" in name for name in names), names

    # The turntable shows one picture at a time, and each of them once.
    scroll_to(".turn")
    browser.screenshot(folder, "report-turn")
    browser.run("document.querySelector('.turn input').focus()")
    seen = []
    for _ in range(24):
        (picture,) = shown(".turn")
        seen.append(picture)
        browser.press("\ue014")  # Right
    assert len(set(seen)) == 24, f"the turntable shows {len(set(seen))} pictures"

    browser.theme("dark")
    scroll_to(".curve")
    browser.screenshot(folder, "report-curves-dark")
    browser.run("document.querySelectorAll('details').forEach((it) => { it.open = true })")
    browser.run("document.querySelector('summary').scrollIntoView()")
    browser.screenshot(folder, "report-details-dark")

    # On a narrow screen, the page fits; wide tables scroll by themselves.
    browser.size(360, 740)
    width = browser.run("return document.documentElement.scrollWidth")
    assert width <= 360, f"the page is {width} px wide"
    browser.run("window.scrollTo(0, 0)")
    browser.screenshot(folder, "report-phone-dark")
    browser.theme("light")
    scroll_to(".pair")
    browser.screenshot(folder, "report-phone-views")
    crops = "return Array.from(document.querySelectorAll('.pair .crops img'), (it) => it.getBoundingClientRect().width)"
    widths = browser.run(crops)
    assert len(widths) > 2 and max(widths) - min(widths) < 0.5, f"crops are {widths} px wide"
    scroll_to(".curve")
    browser.screenshot(folder, "report-phone-curves")

    severe = [entry["message"] for entry in browser.log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    assert not severe, "\n".join(severe)
    events = [json.loads(entry["message"])["message"] for entry in browser.log("performance")]
    urls = {event["params"]["request"]["url"] for event in events if event["method"] == "Network.requestWillBeSent"}
    fetched = [it for it in urls if it != url and not it.startswith("data:")]
    assert url in urls and not fetched, f"the report fetches {fetched}"

    # Without scripts, as in a mail program: photograph and render are side by side.
    browser.command("Emulation.setScriptExecutionDisabled", value=True)
    browser.size(1280, 800)
    browser.open(url)
    browser.command("Emulation.setScriptExecutionDisabled", value=False)
    pictures = shown(".pair")
    assert len(pictures) >= 2 and all(it.endswith("|true|none") for it in pictures), pictures
    assert len(shown(".turn")) == 1, "without scripts, the turntable does not show one picture"
    browser.screenshot(folder, "report-without-scripts")


def main(report: str, folder: str | None = None) -> None:
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
    browser = Browser()
    try:
        check(browser, Path(report), Path(folder) if folder else None)
    finally:
        browser.close()
    print("the report opens from its file, fetches nothing, its sliders work, and it is readable at 360 px and without scripts")


if __name__ == "__main__":
    main(*sys.argv[1:])
