"use strict";
// Build what the view in space draws: slim arrows, and values on a finer grid.

/** Number of edges around an arrow; radii of shaft and head, and length of the head, over the spacing of the arrows. */
const AROUND = 8, SHAFT = 0.022, HEAD = 0.075, HEAD_LENGTH = 0.3;

/** Return two unit vectors that are perpendicular to a unit vector and to each other. */
function perpendicular([x, y, z]) {
  const other = Math.abs(z) < 0.9 ? [0, 0, 1] : [1, 0, 0];
  const first = [y * other[2] - z * other[1], z * other[0] - x * other[2], x * other[1] - y * other[0]];
  const size = Math.hypot(...first);
  const a = first.map((value) => value / size);
  return [a, [y * a[2] - z * a[1], z * a[0] - x * a[2], x * a[1] - y * a[0]]];
}

/** Return arrows, their middles at the vectors, as one mesh; the longest is as long as the vectors are apart. */
function arrowMesh(vectors, spacing, largest) {
  const mesh = { x: [], y: [], z: [], i: [], j: [], k: [], intensity: [], text: [] };
  for (const { place, velocity, text } of vectors) {
    const speed = Math.hypot(...velocity);
    const length = Math.min((speed / largest) * spacing, 1.5 * spacing);
    const along = velocity.map((value) => value / speed);
    const sides = perpendicular(along);
    const thin = Math.min(length / (1.2 * HEAD_LENGTH * spacing), 1); // short arrows are thinner
    const first = mesh.x.length;
    const head = Math.min(HEAD_LENGTH * spacing, 0.6 * length);
    const rings = [[0, SHAFT], [length - head, SHAFT], [length - head, HEAD], [length, 0]];
    for (const [from, radius] of rings) for (let n = 0; n < AROUND; n += 1) {
      const angle = (2 * Math.PI * n) / AROUND;
      const r = thin * radius * spacing;
      const point = place.map((value, axis) => value + (from - length / 2) * along[axis]
        + r * (Math.cos(angle) * sides[0][axis] + Math.sin(angle) * sides[1][axis]));
      ["x", "y", "z"].forEach((name, axis) => mesh[name].push(point[axis]));
      mesh.intensity.push(speed);
      mesh.text.push(text);
    }
    for (let ring = 0; ring + 1 < rings.length; ring += 1) for (let n = 0; n < AROUND; n += 1) {
      const [a, b] = [first + ring * AROUND + n, first + ring * AROUND + ((n + 1) % AROUND)];
      mesh.i.push(a, b);
      mesh.j.push(b, b + AROUND);
      mesh.k.push(a + AROUND, a + AROUND);
    }
  }
  return mesh;
}

/** Return a function that gives the velocity at a place (x, y, z) [cells] in cells, or null outside. */
function fieldSample(field, counts) {
  const parts = ["u", "v", "w"].map((name, axis) => [field.values(name), field.spacing("xyz"[axis])]);
  return (place) => {
    if (place.some((value, axis) => !(value >= -0.5 && value <= counts[axis] - 0.5))) return null;
    const inside = place.map((value, axis) => Math.min(Math.max(value, 0), counts[axis] - 1));
    const low = inside.map((value, axis) => Math.max(Math.min(Math.floor(value), counts[axis] - 2), 0));
    const velocity = parts.map(([values, spacing]) => {
      let total = 0;
      for (let corner = 0; corner < 8; corner += 1) {
        const [i, j, k] = low.map((value, axis) => Math.min(value + ((corner >> axis) & 1), counts[axis] - 1));
        const share = inside.reduce((product, value, axis) => (
          product * ((corner >> axis) & 1 ? value - low[axis] : 1 - value + low[axis])
        ), 1);
        total += share === 0 ? 0 : (share * values[field.index(k, j, i)]) / spacing;
      }
      return total;
    });
    return velocity.every(Number.isFinite) ? velocity : null;
  };
}

/** Return values over (z, y, x) on a grid `factor` times as fine, by cubic interpolation along each axis. */
function refine(values, axes, factor) {
  let fine = Float32Array.from(values);
  const counts = axes.map((axis) => axis.length);
  axes.forEach((_, axis) => {
    const after = counts.slice(axis + 1).reduce((product, n) => product * n, 1);
    const before = counts.slice(0, axis).reduce((product, n) => product * n, 1);
    const [from, to] = [counts[axis], (counts[axis] - 1) * factor + 1];
    const next = new Float32Array(before * to * after);
    for (let outer = 0; outer < before; outer += 1) for (let m = 0; m < to; m += 1) {
      const low = Math.min(Math.floor(m / factor), Math.max(from - 2, 0));
      const shares = cubicShares(m / factor - low);
      const rows = [-1, 0, 1, 2].map((k) => Math.min(Math.max(low + k, 0), from - 1));
      for (let inner = 0; inner < after; inner += 1) {
        let total = 0;
        for (let k = 0; k < 4; k += 1) total += shares[k] * fine[(outer * from + rows[k]) * after + inner];
        next[(outer * to + m) * after + inner] = total;
      }
    }
    counts[axis] = to;
    fine = next;
  });
  const places = axes.map((axis, n) => Array.from({ length: counts[n] }, (_, m) => (
    axis[0] + (axis.length > 1 ? (m / factor) * ((axis[axis.length - 1] - axis[0]) / (axis.length - 1)) : 0)
  )));
  const all = { x: [], y: [], z: [] };
  for (const z of places[0]) for (const y of places[1]) for (const x of places[2]) {
    all.x.push(x);
    all.y.push(y);
    all.z.push(z);
  }
  return { ...all, value: fine };
}

/** Return the shares of four neighbours in a value at `t` from 0 to 1 between the middle two (Catmull and Rom). */
function cubicShares(t) {
  return [
    ((2 - t) * t - 1) * t / 2, ((3 * t - 5) * t * t + 2) / 2, ((4 - 3 * t) * t + 1) * t / 2, (t - 1) * t * t / 2,
  ];
}
