"use strict";
// Start the interactive views. Where one cannot run, its still picture stays.

/** Make tables that are larger than their frame scrollable by keys. */
function markScrollers() {
  for (const frame of document.querySelectorAll(".scroll")) {
    const moves = frame.scrollWidth > frame.clientWidth || frame.scrollHeight > frame.clientHeight;
    if (moves) frame.setAttribute("tabindex", "0");
    else frame.removeAttribute("tabindex");
  }
}

async function startSpace(fields, colours) {
  const view = document.getElementById("space");
  const note = document.getElementById("space-note");
  if (!drawsInSpace()) {
    note.textContent = "This browser draws nothing in space (WebGL is missing or switched off): a still picture.";
    return;
  }
  note.textContent = "Loading the view in space …";
  await loadPlotly();
  view.classList.add("ready");
  note.textContent = "";
  await new SpaceView(fields, colours).start();
  view.dataset.drawn = "true";
}

async function startViews() {
  const list = document.getElementById("field-list");
  if (!list) return;
  if (typeof DecompressionStream === "undefined") {
    const note = document.getElementById("space-note");
    note.textContent = "This browser is too old for the moving views: still pictures.";
    return;
  }
  const { fields: entries, colours } = JSON.parse(list.textContent);
  const block = await unpack("field-values");
  const fields = entries.map((entry) => new Field(entry, block));
  document.getElementById("slices").classList.add("ready");
  window.slices = new SliceView(fields, colours);
  const space = document.getElementById("space");
  const near = new IntersectionObserver((seen) => {
    if (!seen.some((entry) => entry.isIntersecting)) return;
    near.disconnect();
    startSpace(fields, colours);
  }, { rootMargin: "300px" });
  near.observe(space);
}

markScrollers();
document.addEventListener("toggle", markScrollers, true);
window.addEventListener("resize", markScrollers);
startViews();
