// The goal: pictures of the start and of the goal, or two sentences, and the switches that say how they score.

import { $, element } from "./elements.js";
import { ask, attempt } from "./server.js";

const SIDES = ["starts", "goals"];

let goal = { starts: [], goals: [], are_sentences: false }; // of { name, on }
let counted = null; // names of the goals that count, as the server chose by their share
let changed = null; // called when the goal or a switch is another

export function question() {
  const [starts, goals] = SIDES.map((side) => goal[side].filter((item) => item.on).map((item) => item.name));
  if (!starts.length || !goals.length) return null;
  const [features, similarity, reward, share] = ["features", "similarity", "reward", "goal_share"].map(
    (name) => $(`#switches [name=${name}]`).value,
  );
  return { starts, goals, are_sentences: goal.are_sentences, features, similarity, reward, goal_share: Number(share) };
}

// Returns a function that asks the server about the goal as it is, and shows the answer unless a later question has
// overtaken it. `request` returns path and body, or null where there is nothing to ask.
export function answering(request, show) {
  let turn = 0;
  return async () => {
    const [asked, mine] = [question(), ++turn];
    const asks = asked && request(asked);
    const answer = asks ? await ask(...asks) : {};
    if (mine === turn) show(answer, asked);
  };
}

export function beginWith(given) {
  if (SIDES.some((side) => goal[side].length)) return;
  const items = (names) => names.map((name) => ({ name, on: true }));
  goal = { starts: items(given.starts), goals: items(given.goals), are_sentences: given.are_sentences };
}

export async function add(side, names) {
  if (goal.are_sentences) goal = { starts: [], goals: [], are_sentences: false };
  const known = goal[side].map((item) => item.name);
  goal[side].push(...names.filter((name) => !known.includes(name)).map((name) => ({ name, on: true })));
  await changed();
}

async function upload(side, files) {
  const pictures = [...files].filter((file) => file.type.startsWith("image/"));
  if (!pictures.length) throw new Error("drop pictures here: JPEG, PNG, WebP, BMP, GIF or TIFF files");
  const answers = await Promise.all(pictures.map((file) => ask("pictures", file)));
  await add(side, answers.flatMap((answer) => answer.names));
}

export function count(names) {
  counted = names;
  showGoal();
}

export function picture(name) {
  return goal.are_sentences ? element("q", {}, name) : element("img", { src: `pictures/${name}`, alt: "" });
}

export function showGoal() {
  for (const side of SIDES) {
    const held = goal[side].map((item, i) => {
      const label = `${side === "starts" ? "start" : "goal"} ${i + 1}`;
      const toggle = element(
        "button",
        { class: "picture", title: `${label}: switch on or off`, ariaLabel: label, ariaPressed: item.on },
        picture(item.name),
      );
      toggle.addEventListener("click", () => {
        item.on = !item.on;
        attempt(changed);
      });
      const remove = element("button", { class: "remove", title: "remove", ariaLabel: `remove ${label}` }, "×");
      remove.addEventListener("click", () => {
        goal[side].splice(i, 1);
        attempt(changed);
      });
      const counts = side === "starts" || !item.on || !counted || counted.includes(item.name);
      return element("div", { class: counts ? "held" : "held left-out" }, toggle, remove);
    });
    $(`#${side} .pictures`).replaceChildren(...held);
  }
}

export function watchGoal(whenChanged) {
  changed = whenChanged;
  for (const side of SIDES) {
    const zone = $(`#${side}`);
    zone.addEventListener("dragover", (event) => {
      event.preventDefault();
      zone.classList.add("over");
    });
    zone.addEventListener("dragleave", () => zone.classList.remove("over"));
    zone.addEventListener("drop", (event) => {
      event.preventDefault();
      zone.classList.remove("over");
      attempt(() => upload(side, event.dataTransfer.files));
    });
    zone.querySelector("input").addEventListener("change", (event) => {
      const files = [...event.target.files];
      event.target.value = ""; // so that the same file can be chosen again
      attempt(() => upload(side, files));
    });
  }
  document.addEventListener("paste", (event) => {
    if (!event.clipboardData.files.length) return;
    const focused = document.activeElement.closest(".drop")?.id;
    attempt(() => upload(focused ?? (goal.starts.length ? "goals" : "starts"), event.clipboardData.files));
  });
  $("#sentences").addEventListener("submit", (event) => {
    event.preventDefault();
    const [starts, goals] = ["start", "goal"].map((name) => [
      { name: $(`#sentences [name=${name}]`).value.trim(), on: true },
    ]);
    goal = { starts, goals, are_sentences: true };
    attempt(changed);
  });
  $("#switches").addEventListener("input", () => {
    const bringsOwn = !["delta", "raw"].includes($("[name=features]").value);
    if (bringsOwn) $("[name=similarity]").value = "cos";
    $("[name=similarity]").disabled = bringsOwn;
    $("#switches output").textContent = $("[name=goal_share]").value;
    attempt(changed);
  });
}
