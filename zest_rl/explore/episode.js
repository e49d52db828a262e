// The episode that is open: its frames, played or by hand, and its curves, whose cursors move along.

import { chart } from "./charts.js";
import { $ } from "./elements.js";
import { add, answering, picture } from "./goal.js";
import { ask, attempt } from "./server.js";
import { state } from "./state.js";

const KINDS = ["c0", "c1", "c2", "c3", "c4", "c5"];

let opened = null; // { episode, step, charts }
let playing = null; // a token of the latest start

export const openEpisode = () => opened?.episode;

export async function open(episode) {
  stop();
  opened = { episode, step: 0, charts: [] };
  const success = { true: ", a success", false: ", a failure" }[state.facts.success?.[episode]] ?? "";
  $("#episode h2").textContent = `Episode ${episode}`;
  $("#episode .facts").textContent = `${state.facts.steps[episode]} steps${success}`;
  $("#episode .step").max = state.facts.steps[episode];
  $("#episode").hidden = false;
  mark();
  show(0);
  await showCurves();
  if (innerWidth < 900) $("#episode").scrollIntoView({ block: "start" });
}

export function close() {
  stop();
  opened = null;
  $("#episode").hidden = true;
  mark();
}

export function mark() {
  for (const cell of document.querySelectorAll(".cell"))
    cell.ariaCurrent = Number(cell.dataset.episode) === opened?.episode;
}

const ready = () => state.scored.find((each) => each.episode === opened?.episode);

export const showCurves = answering(
  (asked) => ready() && [`curves/${state.dataset}/${opened.episode}`, asked],
  (answer, asked) => {
    if (opened === null) return;
    const charts = [];
    if (answer.scores) {
      charts.push(["Score", [{ name: "all together", kind: "score", values: answer.scores }]]);
      if (answer.by_goal.length > 1)
        charts.push(["By each goal alone", numbered("goal", answer.by_goal, (k) => picture(asked.goals[k]))]);
      if (answer.by_view.length > 1) charts.push(["By each view alone", numbered("view", answer.by_view)]);
      if (answer.truth)
        charts.push([
          "Recorded reward or ground truth, which no score uses",
          [{ name: "recorded", kind: "gt", values: answer.truth }],
        ]);
    }
    opened.charts = charts.map(([title, curves]) => chart(title, curves, seek));
    $("#episode .charts").replaceChildren(...opened.charts.map((each) => each.node));
    $("#episode .words").textContent = ready()?.words ?? "";
    opened.charts.forEach((each) => each.move(opened.step));
  },
);

function numbered(name, curves, pictureOf = () => null) {
  return curves.map((values, i) => ({ name: `${name} ${i + 1}`, kind: KINDS[i % 6], values, picture: pictureOf(i) }));
}

function frame(step) {
  return `frames/${state.dataset}/${opened.episode}/${step}/${$("#episode .view").value}`;
}

function show(step) {
  const last = state.facts.steps[opened.episode];
  opened.step = Math.min(Math.max(step, 0), last);
  $("#episode img").src = frame(opened.step);
  $("#episode img").alt = `episode ${opened.episode} at step ${opened.step}`;
  $("#episode .step").value = opened.step;
  $("#episode .at").textContent = `step ${opened.step} of ${last}`;
  opened.charts.forEach((each) => each.move(opened.step));
}

function seek(step) {
  stop();
  show(step);
}

function stop() {
  playing = null;
  $("#episode .play").textContent = "▶ Play";
}

// Plays as fast as frames come, and no faster than they were recorded.
async function play() {
  if (playing !== null) return stop();
  const mine = (playing = {});
  $("#episode .play").textContent = "❚❚ Pause";
  if (opened.step === state.facts.steps[opened.episode]) show(0);
  while (playing === mine && opened.step < state.facts.steps[opened.episode]) {
    const wait = new Promise((done) => setTimeout(done, 1000 / state.facts.fps));
    const next = Object.assign(new Image(), { src: frame(opened.step + 1) });
    await Promise.all([next.decode().catch(() => {}), wait]);
    if (playing === mine) show(opened.step + 1);
  }
  if (playing === mine) stop();
}

async function take(side) {
  const view = $("#episode .all").checked ? null : Number($("#episode .view").value);
  const answer = await ask(`take/${state.dataset}/${opened.episode}/${opened.step}`, { view });
  await add(side, answer.names);
}

export const KEYS = {
  ArrowRight: () => opened && seek(opened.step + 1),
  ArrowLeft: () => opened && seek(opened.step - 1),
  " ": () => opened && attempt(play),
  s: () => opened && attempt(() => take("starts")),
  g: () => opened && attempt(() => take("goals")),
  Escape: close,
};

export function watchEpisode() {
  $("#episode .step").addEventListener("input", (event) => seek(Number(event.target.value)));
  $("#episode .view").addEventListener("change", () => seek(opened.step));
  $("#episode .play").addEventListener("click", () => attempt(play));
  $("#episode .close").addEventListener("click", close);
  for (const button of document.querySelectorAll(".take"))
    button.addEventListener("click", () => attempt(() => take(button.dataset.side)));
}
