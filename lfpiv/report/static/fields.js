"use strict";
// Data of the page: vector fields, packed by lfpiv/report/fields.py.

const NO_NUMBER = -32768;
const QUANTITIES = {
  u: { label: "u", unit: "m/s", signed: true },
  v: { label: "v", unit: "m/s", signed: true },
  w: { label: "w", unit: "m/s", signed: true },
  speed: { label: "speed", unit: "m/s", signed: false },
  vorticity: { label: "vorticity", unit: "1/s", signed: false },
  q: { label: "Q", unit: "1/s²", signed: true },
};
const COMPONENT = { x: "u", y: "v", z: "w" };
const AXES = ["z", "y", "x"]; // order in memory

/** Bytes behind a script element that holds gzipped base64. */
async function unpack(id) {
  const text = atob(document.getElementById(id).textContent);
  const bytes = new Uint8Array(text.length);
  for (let i = 0; i < text.length; i += 1) bytes[i] = text.charCodeAt(i);
  const stream = new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"));
  return new Response(stream).arrayBuffer();
}

/** One vector field: a pair, the mean over pairs, or their fluctuation. */
class Field {
  constructor(entry, block) {
    this.label = entry.label;
    this.isVector = entry.kind === "velocity";
    this.entry = entry;
    this.block = block;
    this.axis = { x: entry.x, y: entry.y, z: entry.z };
    this.shape = AXES.map((name) => this.axis[name].length);
    this.size = this.shape[0] * this.shape[1] * this.shape[2];
    this.valid = new Int16Array(block, entry.valid, this.size);
    this.cache = {};
  }

  quantities() {
    return Object.keys(QUANTITIES).filter((name) => name === "speed" || name in this.entry.values);
  }

  /** Name of a quantity with its unit. */
  title(name) {
    const { label, unit } = QUANTITIES[name];
    if (this.isVector) return `${label} [${unit}]`;
    return name === "speed" ? "all components [m/s]" : `${label}′ [m/s]`;
  }

  isSigned(name) {
    return this.isVector && QUANTITIES[name].signed;
  }

  /** All values of a quantity, order (z, y, x). */
  values(name) {
    if (!(name in this.cache)) this.cache[name] = name === "speed" ? this.speed() : this.read(name);
    return this.cache[name];
  }

  read(name) {
    const { at, scale } = this.entry.values[name];
    const stored = new Int16Array(this.block, at, this.size);
    return Float32Array.from(stored, (value) => (value === NO_NUMBER ? NaN : value * scale));
  }

  speed() {
    const [u, v, w] = ["u", "v", "w"].map((name) => this.values(name));
    return u.map((value, i) => Math.hypot(value, v[i], w[i]));
  }

  index(k, j, i) {
    return (k * this.shape[1] + j) * this.shape[2] + i;
  }

  /** Valid and known. */
  isGood(at) {
    return this.valid[at] !== 0 && Number.isFinite(this.values("speed")[at]);
  }

  /** Value that a share of the valid ones do not exceed in magnitude. */
  top(name, share) {
    const key = `${name} top ${share}`;
    if (!(key in this.cache)) {
      const values = this.values(name);
      const known = values.map(Math.abs).filter((value, at) => this.isGood(at) && Number.isFinite(value)).sort();
      this.cache[key] = known.length ? known[Math.round((known.length - 1) * share)] : 0;
    }
    return this.cache[key];
  }

  /** Distance of neighbouring vectors along an axis [mm]; that of another axis where there is one layer only. */
  spacing(name) {
    const apart = (axis) => (axis.length > 1 ? (axis[axis.length - 1] - axis[0]) / (axis.length - 1) : NaN);
    const known = [this.axis[name], ...Object.values(this.axis)].map(apart).filter(Number.isFinite);
    return known.length ? known[0] : 1;
  }

  /** Figures of the valid vectors at one place along an axis. */
  summary(normal, place) {
    const sums = { count: 0, good: 0, u: 0, v: 0, w: 0, square: 0, largest: 0 };
    this.forSlice(normal, place, (at) => {
      sums.count += 1;
      if (!this.isGood(at)) return;
      const speed = this.values("speed")[at];
      sums.good += 1;
      for (const name of ["u", "v", "w"]) sums[name] += this.values(name)[at];
      sums.square += speed * speed;
      sums.largest = Math.max(sums.largest, speed);
    });
    const mean = (total) => (sums.good ? total / sums.good : NaN);
    return {
      count: sums.count, good: sums.good, u: mean(sums.u), v: mean(sums.v), w: mean(sums.w),
      rms: Math.sqrt(mean(sums.square)), largest: sums.good ? sums.largest : NaN,
    };
  }

  /** Call with (index, column, row) of every vector of a slice. */
  forSlice(normal, place, visit) {
    const [across, up] = inSlice(normal);
    for (let row = 0; row < this.axis[up].length; row += 1) {
      for (let column = 0; column < this.axis[across].length; column += 1) {
        const at = { [normal]: place, [across]: column, [up]: row };
        visit(this.index(at.z, at.y, at.x), column, row);
      }
    }
  }
}

/** Axes of a slice, across and up. */
function inSlice(normal) {
  return { z: ["x", "y"], y: ["x", "z"], x: ["y", "z"] }[normal];
}

/** Colour at a share from 0 to 1 of a colour map given by stops #rrggbb. */
function colourAt(stops, share) {
  const place = Math.min(Math.max(share, 0), 1) * (stops.length - 1);
  const low = Math.min(Math.floor(place), stops.length - 2);
  const part = (stop, k) => parseInt(stops[stop].slice(1 + 2 * k, 3 + 2 * k), 16);
  const mix = [0, 1, 2].map((k) => Math.round(part(low, k) + (place - low) * (part(low + 1, k) - part(low, k))));
  return `rgb(${mix.join(",")})`;
}

/** Number with so many significant digits, as the tables have it. */
function short(value, digits = 3) {
  if (!Number.isFinite(value)) return "–";
  const rounded = Number(value.toPrecision(digits));
  const size = Math.abs(rounded);
  if (size === 0) return "0";
  const text = size >= 1e-4 && size < 1e6 ? String(rounded) : rounded.toExponential().replace("e+", "e");
  return text.replace(/-/g, "−");
}

/** Number with so many decimals. */
function fixed(value, decimals) {
  return Number.isFinite(value) ? value.toFixed(decimals).replace("-", "−") : "–";
}

function fill(select, entries) {
  const before = select.value;
  select.replaceChildren(...entries.map(([value, text]) => new Option(text, value)));
  if (entries.some(([value]) => String(value) === before)) select.value = before;
}
