"""Tests the page of `densify train --view` in a real browser: its display of a run in training, and its controls.

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
    browser.wait_until_sharp()
    browser.press("\ue007")  # Enter closes the help
    # Curves, edits and the picture are updated during training.
    browser.wait_for(f"Number({STATE}.step) > 300", "training does not proceed")
    for curve in ("psnr", "loss", "rows"):
        browser.wait_for(f"document.querySelector('#{curve}-curve polyline').points.length > 1", f"there is no curve of {curve}")
    browser.wait_for("document.getElementById('edits').rows.length > 0", "no edit was shown")
    before = browser.run("return Number(document.getElementById('stage').dataset.pictures)")
    browser.wait_for(f"Number(document.getElementById('stage').dataset.pictures) > {before}", "the picture is not updated")
    assert browser.run(PROBE)["spread"] > 4, "the picture is empty"
    browser.screenshot(folder, "live")

    # A hidden page requests no pictures, so it does not slow training down; when it is shown again, it is updated.
    hide = "Object.defineProperty(document, 'hidden', { configurable: true, value: true });"
    notify = "document.dispatchEvent(new Event('visibilitychange'));"
    browser.run(hide + notify)
    browser.wait_for("underway === 0", "a requested picture does not arrive")
    before = browser.run("requestPicture(); return requests")
    time.sleep(0.5)
    after = browser.run("return requests")
    assert after == before, f"a hidden page requests {after - before} pictures"
    browser.run("delete document.hidden;" + notify)
    browser.wait_for(f"requests > {before}", "a page that is shown again requests no picture")

    click("pause")
    browser.wait_for(f"{STATE}.state === 'paused'", "the run is not paused")
    assert browser.run("return document.getElementById('pause').textContent") == "Continue"
    paused = step()
    time.sleep(1.5)
    assert step() == paused, "a paused run continues"
    click("one-step")
    browser.wait_for(f"Number({STATE}.step) === {paused + 1}", "the run does not proceed by one step")
    click("checkpoint")
    browser.wait_for("document.getElementById('training-numbers').textContent.includes('Checkpoint of step')", "no checkpoint is shown")
    assert (run / f"checkpoints/iteration_{paused + 1}.safetensors").is_file(), "the checkpoint was not written"
    browser.wait_until_sharp()
    # The heading shows the run's number of Gaussians, whatever it showed before.
    browser.run("scene.models[0].rows = 1; showModels()")
    counts = "document.getElementById('models').textContent.split(': ')[1].replace('Gaussians', 'of at most')"
    browser.wait_for(f"document.getElementById('training-numbers').textContent.includes({counts})", "the heading's count is not updated")
    # Kinds of picture that exist only during training.
    colours = {}
    for kind in browser.run("return scene.kinds.map(({ kind }) => kind)"):
        if kind.startswith("row_"):
            browser.choose("left", f"{kind}:0")
            found = browser.run(PROBE)
            # A signal that the last edit has reset may have no values yet: its picture has few colours, but is not empty.
            assert found["spread"] > 1, f"{kind} is empty"
            colours[kind] = found["colours"]
    assert max(colours.values()) > 12, f"Gaussians have {colours} colours"
    browser.choose("left", "row_edit:0")
    browser.screenshot(folder, "live-edits")
    browser.choose("left", "depth:0")
    browser.run("document.querySelector('details').open = true")
    browser.screenshot(folder, "live-paused")
    browser.check_keyboard_access()
    browser.size(360, 740)
    width = browser.run("return document.getElementById('panel').scrollWidth")
    assert width <= 360, f"the panel is {width} px wide"
    browser.screenshot(folder, "live-phone")
    click("pause")
    browser.wait_for(f"Number({STATE}.step) > {paused + 20}", "the run does not continue")
    browser.run("window.confirm = () => true")
    click("stop")
    browser.wait_for(f"['stopping', 'gone'].includes({STATE}.state)", "the run does not stop")
    browser.wait_for(f"{STATE}.state === 'gone'", "the page does not show that training has ended")
    browser.screenshot(folder, "live-ended")
    messages = [entry["message"] for entry in browser.log("browser") if entry["level"] in ("SEVERE", "WARNING")]
    unexpected = [it for it in messages if "ERR_CONNECTION" not in it and "Failed to load" not in it]
    assert not unexpected, "\n".join(unexpected)


def main(densify: str, run: str, folder: str | None = None) -> None:
    if folder:
        Path(folder).mkdir(parents=True, exist_ok=True)
    command = [densify, "train", "scene:spheres", "-o", run, "--view", "--iterations", str(STEPS), "--budget", "4k", "--eval"]
    command += ["--test-iterations", "100,200,300,400,500", "--backend", "cpu"]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        assert program.stdout
        line = next(line for line in program.stdout if line.startswith("page "))
        browser = Browser()
        try:
            check(browser, line.split()[1], Path(run), Path(folder) if folder else None)
        finally:
            browser.close()
        code = program.wait(PATIENCE)
        assert code == 130, f"a stopped run ends with exit code {code}"
    finally:
        program.kill()
    print("the page of a run in training shows curves and edits, is updated while visible, and pauses, steps, saves and stops the run")


if __name__ == "__main__":
    main(*sys.argv[1:])
