"use strict";
// Draw a vector field in space with plotly.js: cones and a surface of equal value.

/** Largest number of cones; more are thinned out. */
const MOST_CONES = 1500;
/** Buttons above the view, without plotly's own one that uploads the data. */
const BUTTONS = [["toImage"], ["zoom3d", "pan3d", "orbitRotation", "tableRotation", "resetCameraDefault3d"]];
/** Position of the eye at the start, in units of the scene. */
const START_EYE = { x: 1.4, y: -1.6, z: 0.9 };

class SpaceView {
  constructor(fields, colours) {
    this.fields = fields;
    this.colours = colours;
    this.elements = Object.fromEntries(
      ["field", "quantity", "level", "value", "arrows", "scene"].map((name) => [
        name, document.getElementById(`space-${name}`),
      ]),
    );
    fillOptions(this.elements.field, fields.map((field, number) => [number, field.label]));
    this.elements.field.addEventListener("change", () => this.selectField());
    this.elements.quantity.addEventListener("change", () => this.draw());
    this.elements.arrows.addEventListener("change", () => this.draw());
    this.elements.level.addEventListener("input", () => this.moveSurface());
    this.elements.scene.addEventListener("keydown", (event) => this.turn(event));
    this.elements.scene.addEventListener("pointerdown", () => this.elements.scene.focus({ preventScroll: true }));
    this.elements.scene.addEventListener("wheel", (event) => this.keepPageScrolling(event), { capture: true });
    window.matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.draw());
  }

  get field() { return this.fields[Number(this.elements.field.value)]; }
  get quantity() { return this.elements.quantity.value; }

  async start() {
    this.fillQuantities();
    await this.draw();
  }

  selectField() {
    this.fillQuantities();
    this.draw();
  }

  fillQuantities() {
    const first = this.elements.quantity.options.length === 0;
    const names = this.field.quantities().filter((name) => !["u", "v", "w"].includes(name));
    fillOptions(this.elements.quantity, [...names.map((name) => [name, this.field.title(name)]), ["", "none"]]);
    if (first && names.includes("vorticity")) this.elements.quantity.value = "vorticity";
  }

  /** Return the camera at the start, farther away for narrow views. */
  startCamera() {
    const { clientWidth, clientHeight } = this.elements.scene;
    const distance = Math.min(Math.max((1.25 * clientHeight) / clientWidth, 1), 1.7);
    const eye = Object.fromEntries(Object.entries(START_EYE).map(([name, value]) => [name, distance * value]));
    return { eye, up: { x: 0, y: 0, z: 1 }, center: { x: 0, y: 0, z: 0 } };
  }

  /** Return the value of the surface: a share of the 99.5 % quantile. */
  level() {
    return (Number(this.elements.level.value) / 100) * this.field.magnitudeQuantile(this.quantity, 0.995);
  }

  showLevel() {
    const surface = this.quantity !== "";
    const [label, unit] = surface ? this.field.title(this.quantity).split(" [") : ["", "]"];
    const text = surface ? `${label} = ${significant(this.level())} ${unit.slice(0, -1)}` : "no surface";
    this.elements.level.disabled = !surface;
    this.elements.value.textContent = text;
    this.elements.level.setAttribute("aria-valuetext", text);
  }

  /** Return the positions of all vectors, in the order (z, y, x). */
  positions() {
    const { x, y, z } = this.field.axis;
    const all = Object.fromEntries(["x", "y", "z"].map((name) => [name, new Float32Array(this.field.size)]));
    let index = 0;
    for (const depth of z) for (const up of y) for (const across of x) {
      all.x[index] = across;
      all.y[index] = up;
      all.z[index] = depth;
      index += 1;
    }
    return all;
  }

  cones(colour) {
    const { field } = this;
    const positions = this.positions();
    let step = 1;
    while (field.shape.reduce((product, n) => product * Math.ceil(n / step), 1) > MOST_CONES) step += 1;
    const chosen = { x: [], y: [], z: [], u: [], v: [], w: [] };
    for (let k = 0; k < field.shape[0]; k += step) for (let j = 0; j < field.shape[1]; j += step)
      for (let i = 0; i < field.shape[2]; i += step) {
        const index = field.index(k, j, i);
        if (!field.isValid(index) || !(field.values("speed")[index] > 0)) continue;
        for (const name of ["x", "y", "z"]) chosen[name].push(positions[name][index]);
        for (const name of ["u", "v", "w"]) chosen[name].push(field.values(name)[index]);
      }
    const longest = field.magnitudeQuantile("speed", 1);
    const spacing = step * Math.min(...["x", "y", "z"].map((name) => field.spacing(name)));
    return {
      type: "cone", ...chosen, name: "velocity", anchor: "tail", sizemode: "raw", sizeref: (1.2 * spacing) / longest,
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
      type: "isosurface", ...this.positions(), value: known, surface: { count: 1 },
      isomin: this.level(), isomax: this.level(), caps: { x: none, y: none, z: none }, opacity: 0.55,
      showscale: false, hoverinfo: "skip",
      colorscale: [[0, "#d9822b"], [1, "#d9822b"]], lighting: { ambient: 0.6, diffuse: 0.7, specular: 0.1 },
    };
  }

  async draw() {
    this.showLevel();
    const style = getComputedStyle(this.elements.scene);
    const colour = style.color;
    const [grid, quiet] = ["--line", "--quiet"].map((name) => style.getPropertyValue(name).trim());
    const traces = [];
    const moves = this.field.isVector && this.field.magnitudeQuantile("speed", 1) > 0;
    if (moves && this.elements.arrows.checked) traces.push(this.cones(colour));
    if (this.quantity !== "" && this.field.shape.every((n) => n > 1)) traces.push(this.surface());
    this.surfaceNumber = traces.findIndex((trace) => trace.type === "isosurface");
    if (!traces.length) traces.push({ type: "scatter3d", x: [], y: [], z: [], mode: "markers" });
    const axis = (name) => {
      const half = this.field.spacing(name) / 2;
      const positions = this.field.axis[name];
      return {
        title: { text: `${name} [mm]`, font: { size: 12 } },
        range: [positions[0] - half, positions[positions.length - 1] + half],
        color: colour, gridcolor: grid, zerolinecolor: grid, showbackground: false, showspikes: false,
        tickfont: { size: 11 },
        nticks: 6,
      };
    };
    const layout = {
      paper_bgcolor: "rgba(0,0,0,0)", font: { color: colour, family: "system-ui, sans-serif" },
      margin: { l: 0, r: 0, t: 0, b: 0 }, showlegend: false, uirevision: "same",
      modebar: { bgcolor: "rgba(0,0,0,0)", color: quiet, activecolor: colour },
      scene: {
        xaxis: axis("x"), yaxis: axis("y"), zaxis: axis("z"), aspectmode: "data",
        camera: this.startCamera(), bgcolor: "rgba(0,0,0,0)",
      },
    };
    const settings = { responsive: true, displaylogo: false, displayModeBar: true, modeBarButtons: BUTTONS };
    await Plotly.react(this.elements.scene, traces, layout, settings);
  }

  moveSurface() {
    this.showLevel();
    if (this.surfaceNumber < 0 || this.waiting) return;
    this.waiting = true;
    requestAnimationFrame(() => {
      this.waiting = false;
      Plotly.restyle(this.elements.scene, { isomin: this.level(), isomax: this.level() }, [this.surfaceNumber]);
    });
  }

  /** Turn the view by arrow keys, zoom by + and -, reset it by 0. */
  turn(event) {
    if (event.target !== this.elements.scene || event.ctrlKey || event.metaKey || event.altKey) return;
    const now = this.elements.scene._fullLayout.scene.camera;
    const { x, y, z } = now.eye;
    const move = { // azimuth, height, factor of the distance
      ArrowLeft: [-0.12, 0, 1], ArrowRight: [0.12, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1],
      "+": [0, 0, 1 / 1.12], "=": [0, 0, 1 / 1.12], "-": [0, 0, 1.12], 0: [0, 0, 1],
    }[event.key];
    if (!move) return;
    event.preventDefault();
    const azimuth = Math.atan2(y, x) + move[0];
    const height = Math.min(Math.max(Math.atan2(z, Math.hypot(x, y)) + move[1], -1.5), 1.5);
    const distance = Math.hypot(x, y, z) * move[2];
    const radius = distance * Math.cos(height);
    const eye = { x: radius * Math.cos(azimuth), y: radius * Math.sin(azimuth), z: distance * Math.sin(height) };
    Plotly.relayout(this.elements.scene, { "scene.camera": event.key === "0" ? this.startCamera() : { ...now, eye } });
  }

  /** Let the wheel scroll the page unless the view has the focus. */
  keepPageScrolling(event) {
    if (!this.elements.scene.contains(document.activeElement)) event.stopPropagation();
  }
}

function drawsInSpace() {
  const canvas = document.createElement("canvas");
  return Boolean(canvas.getContext("webgl2") || canvas.getContext("webgl"));
}

/** Unpack and run plotly.js. */
async function loadPlotly() {
  const script = document.createElement("script");
  script.textContent = new TextDecoder().decode(await unpack("plotly-source"));
  document.head.append(script);
}
