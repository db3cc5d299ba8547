// Sliders of a report. Without scripts, all pictures are side by side.
"use strict";
document.documentElement.classList.add("live");

// Calls `move` with the horizontal position of a pressed pointer within an element, from 0 to 1.
const whilePressed = (element, move) => {
  const place = ({ clientX }) => {
    const { left, width } = element.getBoundingClientRect();
    move(Math.min(1, Math.max(0, (clientX - left) / width)));
  };
  element.addEventListener("pointerdown", (event) => {
    element.setPointerCapture(event.pointerId);
    place(event);
  });
  element.addEventListener("pointermove", (event) => {
    if (element.hasPointerCapture(event.pointerId)) place(event);
  });
};

// Two overlaid pictures with a movable border.
for (const pair of document.querySelectorAll(".pair")) {
  const stack = pair.querySelector(".stack");
  const slider = pair.querySelector("input");
  const pictures = [...stack.querySelectorAll("img")];
  const show = () => stack.style.setProperty("--at", `${slider.value}%`);
  slider.addEventListener("input", show);
  whilePressed(stack, (place) => {
    slider.value = 100 * place;
    show();
  });
  for (const side of ["left", "right"]) {
    const choice = pair.querySelector(`select.${side}`);
    if (!choice) continue;
    const choose = () => pictures.forEach((it, at) => it.classList.toggle(side, at === Number(choice.value)));
    choice.addEventListener("change", choose);
    choose();
  }
  show();
}

// An orbit around the scene: the slider selects one of its pictures.
for (const turn of document.querySelectorAll(".turn")) {
  const slider = turn.querySelector("input");
  const pictures = [...turn.querySelectorAll("img")];
  const show = () => pictures.forEach((it, at) => { it.hidden = at !== Number(slider.value); });
  slider.addEventListener("input", show);
  whilePressed(turn.querySelector(".stack"), (place) => {
    slider.value = Math.round(place * (pictures.length - 1));
    show();
  });
  show();
}
