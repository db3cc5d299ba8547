"""Drives the page of `densify train --view` in a real browser: what it shows of a run in training, and its orders.

    python live.py DENSIFY RUN [FOLDER FOR SCREENSHOTS]          needs chromium and chromium-driver

Trains a built-in scene into RUN, which must not exist.
"""

import subprocess
import sys
import time
from pathlib import Path

from view import PATIENCE, PROBE, Browser

STEPS = 3000
STATE = "document.getElementById('training').dataset"


def check(browser: Browser, url: str, run: Path, folder: Path | None) -> None:
    def step() -> int:
        return int(browser.run(f"return {STATE}.step"))

    def click(name: str) -> None:
        browser.run("document.getElementById(arguments[0]).click()", name)

    browser.size(1280, 800)
    browser.open(url)
    browser.is_sharp()
    browser.press("\ue007")
    # Curves and edits grow while it trains, and the picture follows it.
    browser.until(f"Number({STATE}.step) > 300", "training does not go on")
    for curve in ("psnr", "loss", "rows"):
        browser.until(f"document.querySelector('#{curve}-curve polyline').points.length > 1", f"no curve of {curve}")
    browser.until("document.getElementById('edits').rows.length > 0", "no edit was shown")
    before = browser.run("return Number(document.getElementById('stage').dataset.pictures)")
    browser.until(f"Number(document.getElementById('stage').dataset.pictures) > {before}", "the picture does not follow")
    assert browser.run(PROBE)["spread"] > 4, "the picture is empty"
    browser.keep(folder, "live")

    # A page that nobody sees lets training alone; seen again, it shows what there is by then.
    hide = "Object.defineProperty(document, 'hidden', { configurable: true, value: true });"
    seen = "document.dispatchEvent(new Event('visibilitychange'));"
    browser.run(hide + seen)
    browser.until("underway === 0", "a picture does not come")
    before = browser.run("requestPicture(); return requests")
    time.sleep(0.5)
    after = browser.run("return requests")
    assert after == before, f"in the background it asks for {after - before} pictures"
    browser.run("delete document.hidden;" + seen)
    browser.until(f"requests > {before}", "seen again, it does not look")

    click("pause")
    browser.until(f"{STATE}.state === 'paused'", "it is not paused")
    assert browser.run("return document.getElementById('pause').textContent") == "Continue"
    paused = step()
    time.sleep(1.5)
    assert step() == paused, "a paused run goes on"
    click("one-step")
    browser.until(f"Number({STATE}.step) === {paused + 1}", "one step is not one")
    click("checkpoint")
    browser.until("document.getElementById('training-numbers').textContent.includes('Checkpoint of step')", "no checkpoint is shown")
    assert (run / f"checkpoints/iteration_{paused + 1}.safetensors").is_file(), "no checkpoint is there"
    browser.is_sharp()
    # The heading counts as the run does, whatever it said before.
    browser.run("scene.models[0].rows = 1; showModels()")
    counts = "document.getElementById('models').textContent.split(': ')[1].replace('Gaussians', 'of at most')"
    browser.until(f"document.getElementById('training-numbers').textContent.includes({counts})", "the heading keeps its count")
    # What only a run in training knows.
    colours = {}
    for kind in browser.run("return scene.kinds.map(({ kind }) => kind)"):
        if kind.startswith("row_"):
            browser.choose("left", f"{kind}:0")
            found = browser.run(PROBE)
            # Some signals may not have been seen since the last edit.
            assert found["spread"] > 1, f"{kind} is empty"
            colours[kind] = found["colours"]
    assert max(colours.values()) > 12, f"Gaussians have {colours} colours"
    browser.choose("left", "row_edit:0")
    browser.keep(folder, "live-edits")
    browser.choose("left", "depth:0")
    browser.run("document.querySelector('details').open = true")
    browser.keep(folder, "live-paused")
    browser.is_reached_by_key()
    browser.size(360, 740)
    width = browser.run("return document.getElementById('panel').scrollWidth")
    assert width <= 360, f"the panel is {width} px wide"
    browser.keep(folder, "live-phone")
    click("pause")
    browser.until(f"Number({STATE}.step) > {paused + 20}", "it does not continue")
    browser.run("window.confirm = () => true")
    click("stop")
    browser.until(f"['stopping', 'gone'].includes({STATE}.state)", "it does not stop")
    browser.until(f"{STATE}.state === 'gone'", "the page does not say that training has ended")
    browser.keep(folder, "live-ended")
    messages = [entry["message"] for entry in browser.log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    strange = [it for it in messages if "ERR_CONNECTION" not in it and "Failed to load" not in it]
    assert not strange, "\n".join(strange)


def main(densify: str, run: str, folder: str | None = None) -> None:
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
    command = [densify, "train", "scene:spheres", "-o", run, "--view", "--iterations", str(STEPS), "--budget", "4k", "--eval"]
    tests = ["--test-iterations", "100,200,300,400,500", "--backend", "cpu"]
    program = subprocess.Popen(command + tests, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert program.stdout
        line = next(line for line in program.stdout if line.startswith("page "))
        browser = Browser()
        try:
            check(browser, line.split()[1], Path(run), Path(folder) if folder else None)
        finally:
            browser.close()
        code = program.wait(PATIENCE)
        assert code == 130, f"a stopped run ends with {code}"
    finally:
        program.kill()
    print("the page of a run in training shows curves and edits, follows it while it is seen, and pauses, steps, keeps and stops it")


if __name__ == "__main__":
    main(*sys.argv[1:])
