// The page of a run in training: its progress, curves and edits, and commands to it.
"use strict";

/** Interval between requests for the progress [ms]. */
const ASK_EVERY = 1000;
/** Minimum time between two pictures of the changing model [ms]. */
const PICTURE_EVERY = 2000;

/** Shows the progress of the run in training, and requests pictures of its changing model. */
function followTraining(requestPicture) {
  const section = byId("training");
  section.hidden = false;
  let previous = null, requestedAt = 0, requestedStep = -1;
  const number = (value) => value.toLocaleString("en");

  const order = async (command) => {
    const answer = await fetch("order", {
      method: "POST",
      headers: { "Content-Type": "application/json" },
      body: JSON.stringify({ order: command }),
    });
    if (!answer.ok) byId("training-trouble").textContent = await answer.text();
    await ask();
  };
  byId("pause").addEventListener("click", () => order(previous?.state === "paused" ? "continue" : "pause"));
  byId("one-step").addEventListener("click", () => order("step"));
  byId("checkpoint").addEventListener("click", () => order("checkpoint"));
  byId("stop").addEventListener("click", () => {
    if (confirm("Stop training? A checkpoint is written first; densify train --resume continues from it.")) order("stop");
  });

  async function ask() {
    let now;
    try {
      const answer = await fetch("progress");
      if (!answer.ok) throw new Error(await answer.text());
      now = await answer.json();
    } catch {
      byId("training-state").textContent = "Training has ended, or densify was stopped. The results are in the run’s folder.";
      for (const id of ["pause", "one-step", "checkpoint", "stop"]) byId(id).disabled = true;
      section.dataset.state = "gone";
      return false;
    }
    showProgress(now);
    const isDue = performance.now() - requestedAt >= PICTURE_EVERY || now.state === "paused";
    if (now.step !== requestedStep && isDue && stage.dataset.state === "sharp") {
      [requestedAt, requestedStep] = [performance.now(), now.step];
      requestPicture();
    }
    previous = now;
    return true;
  }

  function showProgress(now) {
    const { state, step, last, rows, budget, seconds, points, tests, edits, checkpoint } = now;
    section.dataset.state = state;
    section.dataset.step = step;
    scene.models[0].rows = rows;
    showModels();
    byId("training-progress").max = last;
    byId("training-progress").value = step;
    const words = { preparing: "Preparing", training: "Training", paused: "Paused", stopping: "Stopping", ended: "Measuring and saving" };
    const left = step && state === "training" ? `, about ${formatDuration(seconds / step * (last - step))} left` : "";
    byId("training-state").textContent = `${words[state]}: step ${number(step)} of ${number(last)}${left}.`;
    const loss = points.at(-1)?.loss;
    const psnr = tests.at(-1)?.[1];
    byId("training-numbers").textContent = [
      loss === undefined ? "" : `Loss ${loss.toFixed(4)}. `,
      `${number(rows)} of at most ${number(budget)} Gaussians.`,
      typeof psnr === "number" ? ` Test PSNR ${psnr.toFixed(2)} dB.` : "",
      checkpoint === null ? "" : ` Checkpoint of step ${number(checkpoint)}.`,
    ].join("");
    byId("training-trouble").textContent = now.trouble ?? "";
    byId("pause").textContent = state === "paused" ? "Continue" : "Pause";
    const isOver = state === "stopping" || state === "ended";
    for (const id of ["pause", "one-step", "checkpoint", "stop"]) byId(id).disabled = isOver;
    curve("loss-curve", points.map((p) => [p.step, p.loss]), last, (y) => y.toPrecision(3));
    curve("rows-curve", points.map((p) => [p.step, p.rows]), last, (y) => number(Math.round(y)));
    curve("psnr-curve", tests, last, (y) => `${y.toFixed(2)} dB`);
    const log = byId("edits");
    log.replaceChildren(...edits.slice(-20).reverse().map((edit) => {
      const row = document.createElement("tr");
      for (const cell of [number(edit.step), edit.cause || "–", `+${number(edit.added)}`, `−${number(edit.removed)}`, number(edit.after)]) {
        row.append(Object.assign(document.createElement("td"), { textContent: cell }));
      }
      return row;
    }));
    byId("no-edits").hidden = edits.length > 0;
  }

  /** Formats a duration. */
  function formatDuration(seconds) {
    if (seconds < 90) return `${Math.ceil(seconds)} s`;
    return seconds < 5400 ? `${Math.round(seconds / 60)} min` : `${(seconds / 3600).toFixed(1)} h`;
  }

  /** Draws a curve over the whole length of the run, and shows its newest value. */
  function curve(id, all, last, format) {
    const figure = byId(id), points = all.filter(([, y]) => Number.isFinite(y));
    figure.hidden = points.length === 0;
    if (!points.length) return;
    const values = points.map(([, y]) => y);
    const least = Math.min(...values), most = Math.max(...values), range = most - least || 1;
    const place = ([x, y]) => `${(100 * x / last).toFixed(2)},${(38 - 36 * (y - least) / range).toFixed(2)}`;
    figure.querySelector("polyline").setAttribute("points", points.map(place).join(" "));
    figure.querySelector("output").textContent = format(points.at(-1)[1]);
    figure.querySelector(".ends").textContent = `${format(least)} to ${format(most)}`;
  }

  const poll = async () => {
    if (await ask()) setTimeout(poll, document.hidden ? 5 * ASK_EVERY : ASK_EVERY);
  };
  poll();
}
