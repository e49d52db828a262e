"use strict";

// Ties the video of an episode to its charts: the cursor follows the video, and the chart seeks it.
// Without this script the page still shows everything; the video then has the browser's own controls.

function connect(episode) {
  const video = episode.querySelector("video");
  const slider = episode.querySelector(".scrubber");
  const button = episode.querySelector("button");
  const tracks = [...slider.querySelectorAll(".track")].map((track) => ({
    name: track.dataset.name,
    output: track.querySelector(".value"),
    cursor: track.querySelector(".cursor"),
    dot: track.querySelector(".dot"),
    low: Number(track.querySelector(".chart").dataset.low),
    high: Number(track.querySelector(".chart").dataset.high),
    values: JSON.parse(track.querySelector(".chart").dataset.values),
  }));
  const fps = Number(slider.dataset.fps);
  const last = Number(slider.getAttribute("aria-valuemax"));
  let current = 0;

  function show(step) {
    current = step;
    const x = `${(100 * step) / last}%`;
    const spoken = tracks.map((track) => {
      const value = track.values[step];
      const text = value === null ? "–" : value.toFixed(3).replace("-", "−");
      track.output.textContent = text;
      track.cursor.setAttribute("x1", x);
      track.cursor.setAttribute("x2", x);
      track.dot.setAttribute("visibility", value === null ? "hidden" : "visible");
      if (value !== null) {
        track.dot.setAttribute("cx", x);
        track.dot.setAttribute("cy", `${(100 * (track.high - value)) / (track.high - track.low)}%`);
      }
      return `${track.name} ${text}`;
    });
    episode.querySelector(".step").textContent = `step ${step} of ${last}`;
    slider.setAttribute("aria-valuenow", step);
    slider.setAttribute("aria-valuetext", `step ${step} of ${last}, ${spoken.join(", ")}`);
  }

  function seek(step) {
    const target = Math.min(Math.max(step, 0), last);
    video.pause();
    video.currentTime = (target + 0.5) / fps; // the middle of the frame, so that rounding cannot miss it
    show(target);
  }

  function update() {
    if (!video.seeking) show(Math.min(last, Math.floor(video.currentTime * fps + 1e-3)));
  }

  function follow() {
    update();
    if (!video.paused) requestAnimationFrame(follow);
  }

  function toggle() {
    if (!video.paused) {
      video.pause();
      return;
    }
    if (current === last) video.currentTime = 0;
    video.play().catch(() => {}); // a video that cannot play reports it through "error"
  }

  function seekToPointer(event) {
    const box = slider.querySelector(".hit").getBoundingClientRect();
    seek(Math.round((last * (event.clientX - box.left)) / box.width));
  }

  const keys = {
    ArrowLeft: () => seek(current - 1),
    ArrowDown: () => seek(current - 1),
    ArrowRight: () => seek(current + 1),
    ArrowUp: () => seek(current + 1),
    PageDown: () => seek(current - 10),
    PageUp: () => seek(current + 10),
    Home: () => seek(0),
    End: () => seek(last),
    " ": toggle,
  };
  slider.addEventListener("keydown", (event) => {
    if (!(event.key in keys) || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    keys[event.key]();
  });
  slider.addEventListener("pointerdown", (event) => {
    if (event.button !== 0 || !event.target.closest(".chart")) return;
    slider.setPointerCapture(event.pointerId);
    seekToPointer(event);
  });
  slider.addEventListener("pointermove", (event) => {
    if (slider.hasPointerCapture(event.pointerId)) seekToPointer(event);
  });

  for (const type of ["seeked", "timeupdate"]) video.addEventListener(type, update);
  video.addEventListener("play", () => {
    button.textContent = "❚❚ Pause";
    follow();
  });
  for (const type of ["pause", "ended"]) video.addEventListener(type, () => (button.textContent = "▶ Play"));
  video.addEventListener("click", toggle);
  video.addEventListener("error", () => (episode.querySelector(".broken").hidden = false));
  if (video.error) episode.querySelector(".broken").hidden = false;
  button.addEventListener("click", toggle);
  video.controls = false;
  episode.querySelector(".transport").hidden = false;
  seek(last); // how it ended; playing starts over
}

document.querySelectorAll(".episode").forEach(connect);
