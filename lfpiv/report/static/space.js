"use strict";
// Draw a vector field in space with plotly.js: arrows, streamlines and a surface of equal value.

/** Largest number of arrows; more are thinned out. */
const MOST_ARROWS = 700;
/** Largest number of streamlines. */
const MOST_LINES = 300;
/** Largest number of values of a surface. */
const MOST_IN_SURFACE = 60000;
/** Buttons above the view, without plotly's own one that uploads the data. */
const BUTTONS = [["toImage"], ["zoom3d", "pan3d", "orbitRotation", "tableRotation", "resetCameraDefault3d"]];
/** Direction of the eye at the start, and its distance over the diagonal of the volume. */
const START_EYE = { x: 0.62, y: -0.68, z: 0.4 }, START_DISTANCE = 1.08;

class SpaceView {
  constructor(fields, colours) {
    this.fields = fields;
    this.colours = colours;
    this.elements = Object.fromEntries(
      ["field", "quantity", "level", "value", "arrows", "lines", "scene"].map((name) => [
        name, document.getElementById(`space-${name}`),
      ]),
    );
    fillOptions(this.elements.field, fields.map((field, number) => [number, field.label]));
    this.elements.field.addEventListener("change", () => this.selectField());
    this.elements.quantity.addEventListener("change", () => this.draw());
    this.elements.arrows.addEventListener("change", () => this.draw());
    this.elements.lines.addEventListener("change", () => this.draw());
    this.elements.level.addEventListener("input", () => this.moveSurface());
    this.elements.scene.addEventListener("keydown", (event) => this.turn(event));
    this.elements.scene.addEventListener("pointerdown", () => this.elements.scene.focus({ preventScroll: true }));
    this.elements.scene.addEventListener("wheel", (event) => this.keepPageScrolling(event), { capture: true });
    for (const query of ["(prefers-color-scheme: dark)", "(max-width: 700px)"]) {
      window.matchMedia(query).addEventListener("change", () => this.redraw());
    }
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
    const names = this.field.quantities().filter((name) => !["u", "v", "w", "uncertainty"].includes(name));
    fillOptions(this.elements.quantity, [...names.map((name) => [name, this.field.title(name)]), ["", "none"]]);
    if (first && names.includes("q")) this.elements.quantity.value = "q"; // positive inside vortices
  }

  /** Return the camera at the start: so far that the volume fills the view, farther for narrow views. */
  startCamera() {
    const { clientWidth, clientHeight } = this.elements.scene;
    const spans = ["x", "y", "z"].map((name) => this.field.spacing(name) * this.field.axis[name].length);
    const unit = Math.cbrt(spans[0] * spans[1] * spans[2]); // plotly's unit of length for aspectmode "data"
    const narrow = Math.min(Math.max((1.5 * clientHeight) / clientWidth, 1), 1.8);
    const distance = (START_DISTANCE * narrow * Math.hypot(...spans)) / unit;
    const eye = Object.fromEntries(Object.entries(START_EYE).map(([name, value]) => [name, distance * value]));
    return { eye, up: { x: 0, y: 0, z: 1 }, center: { x: 0, y: 0, z: -0.06 } };
  }

  /** Return the value of the surface: a share of the 99.5 % quantile of the positive values. */
  level() {
    return (Number(this.elements.level.value) / 100) * this.field.positiveQuantile(this.quantity, 0.995);
  }

  showLevel() {
    const surface = this.quantity !== "";
    const [label, unit] = surface ? this.field.title(this.quantity).split(" [") : ["", "]"];
    const text = surface ? `${label} = ${significant(this.level())} ${unit.slice(0, -1)}` : "no surface";
    this.elements.level.disabled = !surface;
    this.elements.value.textContent = text;
    this.elements.level.setAttribute("aria-valuetext", text);
  }

  /** Return whether the view is as narrow as a phone's. */
  get isNarrow() { return this.elements.scene.clientWidth < 600; }

  /** Return how colours show the speed, with the colour bar, which lies below a narrow view. */
  colouring(colour) {
    const stops = this.colours.positive;
    const place = this.isNarrow
      ? { orientation: "h", x: 0.5, xanchor: "center", y: 0, yanchor: "bottom", len: 0.8 }
      : { x: 1, xpad: 4, len: 0.7 };
    return {
      cmin: 0, cmax: this.field.magnitudeQuantile("speed", 0.995),
      colorscale: stops.map((stop, k) => [k / (stops.length - 1), stop]),
      colorbar: {
        title: { text: this.field.title("speed"), side: this.isNarrow ? "bottom" : "right", font: { color: colour } },
        thickness: 12, tickfont: { color: colour }, nticks: 6, ...place,
      },
    };
  }

  arrows(colour) {
    const { field } = this;
    let step = 1;
    while (field.shape.reduce((product, n) => product * Math.ceil(n / step), 1) > MOST_ARROWS) step += 1;
    const starts = field.shape.map((n) => Math.min(Math.floor((step - 1) / 2), n - 1));
    const unit = QUANTITIES.speed.unit;
    const chosen = [];
    for (let k = starts[0]; k < field.shape[0]; k += step) for (let j = starts[1]; j < field.shape[1]; j += step)
      for (let i = starts[2]; i < field.shape[2]; i += step) {
        const index = field.index(k, j, i);
        if (!field.isValid(index) || !(field.values("speed")[index] > 0)) continue;
        const place = [field.axis.x[i], field.axis.y[j], field.axis.z[k]];
        const velocity = ["u", "v", "w"].map((name) => field.values(name)[index]);
        const where = ["x", "y", "z"].map((name, axis) => `${name} ${fixed(place[axis], 3)}`).join(", ");
        const parts = ["u", "v", "w"].map((name, axis) => `${name} ${significant(velocity[axis])}`).join(", ");
        chosen.push({ place, velocity, text: `${where} mm<br>${parts} ${unit}` });
      }
    const spacing = step * Math.min(...["x", "y", "z"].map((name) => field.spacing(name)));
    const mesh = arrowMesh(chosen, spacing, field.magnitudeQuantile("speed", 0.995));
    return {
      type: "mesh3d", ...mesh, name: "velocity", ...this.colouring(colour), flatshading: false,
      hovertemplate: "%{text}<extra></extra>", lighting: { ambient: 0.85, diffuse: 0.35, specular: 0.05 },
    };
  }

  /** Return the streamlines as one trace, broken by gaps. */
  streamlines(colour) {
    const { field } = this;
    const { axis } = field;
    const names = ["x", "y", "z"];
    const counts = names.map((name) => axis[name].length);
    const sample = fieldSample(field, counts);
    const spacing = names.map((name) => field.spacing(name));
    const apart = Math.max(Math.cbrt((counts[0] * counts[1] * counts[2]) / MOST_LINES), 1);
    const largest = field.magnitudeQuantile("speed", 0.995) / Math.min(...spacing);
    const found = streamlines(sample, counts, apart, largest, MOST_LINES);
    const trace = { x: [], y: [], z: [], speed: [] };
    for (const places of found) {
      places.forEach((place, k) => {
        if (k % 2) return;
        names.forEach((name, n) => trace[name].push(axis[name][0] + place[n] * spacing[n]));
        trace.speed.push(Math.hypot(...sample(place).map((value, n) => value * spacing[n])));
      });
      for (const name of names) trace[name].push(null);
      trace.speed.push(0);
    }
    const { x, y, z, speed } = trace;
    return {
      type: "scatter3d", mode: "lines", x, y, z, name: "streamlines", hoverinfo: "skip",
      line: { width: 5, color: speed, ...this.colouring(colour), showscale: !this.elements.arrows.checked },
    };
  }

  /** Return a surface of equal value, through values interpolated to a finer grid, which make it smooth. */
  surface() {
    const known = this.field.values(this.quantity).map((value) => (Number.isFinite(value) ? value : 0));
    const factor = Math.min(Math.max(Math.floor(Math.cbrt(MOST_IN_SURFACE / known.length)), 1), 4);
    const fine = refine(known, AXES.map((name) => this.field.axis[name]), factor);
    const none = { show: false };
    return {
      type: "isosurface", ...fine, surface: { count: 1 }, isomin: this.level(), isomax: this.level(),
      caps: { x: none, y: none, z: none }, opacity: 0.6, flatshading: false, showscale: false, hoverinfo: "skip",
      colorscale: [[0, "#d9822b"], [1, "#d9822b"]], lighting: { ambient: 0.65, diffuse: 0.7, specular: 0.15 },
    };
  }

  async draw() {
    this.showLevel();
    const style = getComputedStyle(this.elements.scene);
    const colour = style.color;
    const [grid, quiet] = ["--line", "--quiet"].map((name) => style.getPropertyValue(name).trim());
    const traces = [];
    const moves = this.field.isVector && this.field.magnitudeQuantile("speed", 1) > 0;
    if (moves && this.elements.arrows.checked) traces.push(this.arrows(colour));
    if (moves && this.elements.lines.checked) traces.push(this.streamlines(colour));
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
        domain: { y: [this.isNarrow ? 0.14 : 0, 1] }, xaxis: axis("x"), yaxis: axis("y"), zaxis: axis("z"), aspectmode: "data",
        camera: this.startCamera(), bgcolor: "rgba(0,0,0,0)",
      },
    };
    const settings = { responsive: true, displaylogo: false, displayModeBar: true, modeBarButtons: BUTTONS };
    await Plotly.react(this.elements.scene, traces, layout, settings);
  }

  /** Draw from the beginning for another width or scheme: plotly would keep the margins that it drew first. */
  async redraw() {
    Plotly.purge(this.elements.scene);
    await this.draw();
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
