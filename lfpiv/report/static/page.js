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
  const { fields: entries, colours, quantities, voxel, start } = JSON.parse(list.textContent);
  QUANTITIES = quantities;
  VOXEL = voxel;
  const block = await unpack("field-values");
  const fields = entries.map((entry) => new Field(entry, block));
  document.getElementById("slices").classList.add("ready");
  window.slices = new SliceView(fields, colours, start, new ProfileView());
  const space = document.getElementById("space");
  const near = new IntersectionObserver((seen) => {
    if (!seen.some((entry) => entry.isIntersecting)) return;
    near.disconnect();
    startSpace(fields, colours);
  }, { rootMargin: "300px" });
  near.observe(space);
}

/** Mark the link to the section that is read. */
function followSections() {
  const links = [...document.querySelectorAll("nav a[href^='#']")];
  const heads = links.map((link) => document.getElementById(link.hash.slice(1))).filter((head) => head?.tagName === "H2");
  let waiting = false;
  const mark = () => {
    waiting = false;
    const read = heads.filter((head) => head.getBoundingClientRect().top < 120).pop();
    for (const link of links) {
      if (read && link.hash === `#${read.id}`) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    }
  };
  window.addEventListener("scroll", () => {
    if (!waiting) requestAnimationFrame(mark);
    waiting = true;
  }, { passive: true });
}

/** Unfold the section that a link leads to. */
function unfoldTarget() {
  const folded = document.getElementById(`${window.location.hash.slice(1)}-fold`);
  if (folded) folded.open = true;
}

markScrollers();
followSections();
window.addEventListener("hashchange", unfoldTarget);
unfoldTarget();
document.addEventListener("toggle", markScrollers, true);
window.addEventListener("resize", markScrollers);
startViews();
