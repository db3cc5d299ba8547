// Sliders of a report. Without this, all pictures are shown beside each other.
"use strict";
document.documentElement.classList.add("live");

// Calls `move` with the place of a pointer across an element, from 0 to 1, while it is pressed there.
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

// Two of several pictures, with a border between them.
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

// One of many pictures: a turn around the scene.
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
