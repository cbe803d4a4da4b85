"use strict";
// A vector field in space, drawn by plotly.js: cones and a surface of equal value.

const MOST_CONES = 1500;
/** Buttons over the view; plotly's own choice has one that uploads the data. */
const BUTTONS = [["toImage"], ["zoom3d", "pan3d", "orbitRotation", "tableRotation", "resetCameraDefault3d"]];
const HOME = { x: 1.4, y: -1.6, z: 0.9 }; // where the eye is at first, in units of the scene

class SpaceView {
  constructor(fields, colours) {
    this.fields = fields;
    this.colours = colours;
    this.part = Object.fromEntries(
      ["field", "quantity", "level", "value", "arrows", "scene"].map((name) => [
        name, document.getElementById(`space-${name}`),
      ]),
    );
    fill(this.part.field, fields.map((field, number) => [number, field.label]));
    this.part.field.addEventListener("change", () => this.takeField());
    this.part.quantity.addEventListener("change", () => this.draw());
    this.part.arrows.addEventListener("change", () => this.draw());
    this.part.level.addEventListener("input", () => this.moveSurface());
    this.part.scene.addEventListener("keydown", (event) => this.turn(event));
    this.part.scene.addEventListener("pointerdown", () => this.part.scene.focus({ preventScroll: true }));
    this.part.scene.addEventListener("wheel", (event) => this.keepPageScrolling(event), { capture: true });
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  get field() { return this.fields[Number(this.part.field.value)]; }
  get quantity() { return this.part.quantity.value; }

  async start() {
    this.fillQuantities();
    await this.draw();
  }

  takeField() {
    this.fillQuantities();
    this.draw();
  }

  fillQuantities() {
    const first = this.part.quantity.options.length === 0;
    const names = this.field.quantities().filter((name) => !["u", "v", "w"].includes(name));
    fill(this.part.quantity, [...names.map((name) => [name, this.field.title(name)]), ["", "none"]]);
    if (first && names.includes("vorticity")) this.part.quantity.value = "vorticity";
  }

  /** Camera at the start; farther away where the view is narrow. */
  home() {
    const { clientWidth, clientHeight } = this.part.scene;
    const far = Math.min(Math.max((1.25 * clientHeight) / clientWidth, 1), 1.7);
    const eye = Object.fromEntries(Object.entries(HOME).map(([name, value]) => [name, far * value]));
    return { eye, up: { x: 0, y: 0, z: 1 }, center: { x: 0, y: 0, z: 0 } };
  }

  /** Value of the surface: a share of the largest positive values, outliers left out. */
  level() {
    return (Number(this.part.level.value) / 100) * this.field.top(this.quantity, 0.995);
  }

  sayLevel() {
    const surface = this.quantity !== "";
    const [label, unit] = surface ? this.field.title(this.quantity).split(" [") : ["", "]"];
    const text = surface ? `${label} = ${short(this.level())} ${unit.slice(0, -1)}` : "no surface";
    this.part.level.disabled = !surface;
    this.part.value.textContent = text;
    this.part.level.setAttribute("aria-valuetext", text);
  }

  /** Places of all vectors, order (z, y, x). */
  places() {
    const { x, y, z } = this.field.axis;
    const all = Object.fromEntries(["x", "y", "z"].map((name) => [name, new Float32Array(this.field.size)]));
    let at = 0;
    for (const depth of z) for (const up of y) for (const across of x) {
      all.x[at] = across;
      all.y[at] = up;
      all.z[at] = depth;
      at += 1;
    }
    return all;
  }

  cones(colour) {
    const { field } = this;
    const places = this.places();
    let step = 1;
    while (field.shape.reduce((product, n) => product * Math.ceil(n / step), 1) > MOST_CONES) step += 1;
    const kept = { x: [], y: [], z: [], u: [], v: [], w: [] };
    for (let k = 0; k < field.shape[0]; k += step) for (let j = 0; j < field.shape[1]; j += step)
      for (let i = 0; i < field.shape[2]; i += step) {
        const at = field.index(k, j, i);
        if (!field.isGood(at) || !(field.values("speed")[at] > 0)) continue;
        for (const name of ["x", "y", "z"]) kept[name].push(places[name][at]);
        for (const name of ["u", "v", "w"]) kept[name].push(field.values(name)[at]);
      }
    const longest = field.top("speed", 1);
    const apart = step * Math.min(...["x", "y", "z"].map((name) => field.spacing(name)));
    return {
      type: "cone", ...kept, name: "velocity", anchor: "tail", sizemode: "raw", sizeref: (1.2 * apart) / longest,
      cmin: 0, cmax: longest, colorscale: this.colours.positive.map((stop, k, all) => [k / (all.length - 1), stop]),
      colorbar: {
        title: { text: "speed [m/s]", side: "right", font: { color: colour } }, thickness: 12, len: 0.7,
        tickfont: { color: colour }, x: 1, xpad: 4,
      },
      hovertemplate: "x %{x:.3f}, y %{y:.3f}, z %{z:.3f} mm<br>u %{u:.4g}, v %{v:.4g}, w %{w:.4g} m/s<extra></extra>",
    };
  }

  surface() {
    const known = this.field.values(this.quantity).map((value) => (Number.isFinite(value) ? value : 0));
    const none = { show: false };
    return {
      type: "isosurface", ...this.places(), value: known, surface: { count: 1 },
      isomin: this.level(), isomax: this.level(), caps: { x: none, y: none, z: none }, opacity: 0.55,
      showscale: false, hoverinfo: "skip",
      colorscale: [[0, "#d9822b"], [1, "#d9822b"]], lighting: { ambient: 0.6, diffuse: 0.7, specular: 0.1 },
    };
  }

  async draw() {
    this.sayLevel();
    const style = getComputedStyle(this.part.scene);
    const colour = style.color;
    const [grid, quiet] = ["--line", "--quiet"].map((name) => style.getPropertyValue(name).trim());
    const traces = [];
    const moves = this.field.isVector && this.field.top("speed", 1) > 0;
    if (moves && this.part.arrows.checked) traces.push(this.cones(colour));
    if (this.quantity !== "" && this.field.shape.every((n) => n > 1)) traces.push(this.surface());
    this.surfaceNumber = traces.findIndex((trace) => trace.type === "isosurface");
    if (!traces.length) traces.push({ type: "scatter3d", x: [], y: [], z: [], mode: "markers" });
    const axis = (name) => {
      const half = this.field.spacing(name) / 2;
      const places = this.field.axis[name];
      return {
        title: { text: `${name} [mm]`, font: { size: 12 } },
        range: [places[0] - half, places[places.length - 1] + half],
        color: colour, gridcolor: grid, zerolinecolor: grid, showbackground: false, showspikes: false,
        tickfont: { size: 11 },
        nticks: 6,
      };
    };
    const layout = {
      paper_bgcolor: "rgba(0,0,0,0)", font: { color: colour, family: "system-ui, sans-serif" },
      margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, uirevision: "kept",
      modebar: { bgcolor: "rgba(0,0,0,0)", color: quiet, activecolor: colour },
      scene: {
        xaxis: axis("x"), yaxis: axis("y"), zaxis: axis("z"), aspectmode: "data",
        camera: this.home(), bgcolor: "rgba(0,0,0,0)",
      },
    };
    const settings = { responsive: true, displaylogo: false, displayModeBar: true, modeBarButtons: BUTTONS };
    await Plotly.react(this.part.scene, traces, layout, settings);
  }

  moveSurface() {
    this.sayLevel();
    if (this.surfaceNumber < 0 || this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      Plotly.restyle(this.part.scene, { isomin: this.level(), isomax: this.level() }, [this.surfaceNumber]);
    });
  }

  /** Keys turn the view about the vertical and the horizontal, zoom, or put it back. */
  turn(event) {
    if (event.target !== this.part.scene || event.ctrlKey || event.metaKey || event.altKey) return;
    const now = this.part.scene._fullLayout.scene.camera;
    const { x, y, z } = now.eye;
    const move = { // turn, lift, distance
      ArrowLeft: [-0.12, 0, 1], ArrowRight: [0.12, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1],
      "+": [0, 0, 1 / 1.12], "=": [0, 0, 1 / 1.12], "-": [0, 0, 1.12], 0: [0, 0, 1],
    }[event.key];
    if (!move) return;
    event.preventDefault();
    const round = Math.atan2(y, x) + move[0];
    const height = Math.min(Math.max(Math.atan2(z, Math.hypot(x, y)) + move[1], -1.5), 1.5);
    const far = Math.hypot(x, y, z) * move[2];
    const level = far * Math.cos(height);
    const eye = { x: level * Math.cos(round), y: level * Math.sin(round), z: far * Math.sin(height) };
    Plotly.relayout(this.part.scene, { "scene.camera": event.key === "0" ? this.home() : { ...now, eye } });
  }

  /** The wheel scrolls the page until the view is chosen. */
  keepPageScrolling(event) {
    if (!this.part.scene.contains(document.activeElement)) event.stopPropagation();
  }
}

function drawsInSpace() {
  const canvas = document.createElement("canvas");
  return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
}

/** Run plotly.js, which the page holds packed. */
async function loadPlotly() {
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(await unpack("plotly-source"));
  document.head.append(script);
}
