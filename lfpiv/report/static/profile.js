"use strict";
// Draw the velocity along a line through the field, with its uncertainty.

const PROFILE_MARGIN = { left: 64, right: 14, top: 34, bottom: 40 };
/** Standard deviations to either side that a band shows. */
const BAND = 2;

class ProfileView {
  constructor() {
    this.canvas = document.getElementById("profile-canvas");
    this.reading = document.getElementById("profile-reading");
  }

  /** Return the components and the errors along a line through a place; replaced vectors are marked. */
  values(field, place, along) {
    return field.axis[along].map((position, k) => {
      const index = field.index(...AXES.map((name) => (name === along ? k : place[name])));
      const masked = field.isMasked(index);
      return {
        position,
        velocity: ["u", "v", "w"].map((name) => (masked ? NaN : field.values(name)[index])),
        error: BAND * field.velocityError(index),
        valid: field.isValid(index),
      };
    });
  }

  draw(field, place, along, ink) {
    const outerWidth = this.canvas.parentElement.clientWidth;
    if (!(outerWidth > 0)) return;
    const points = this.values(field, place, along);
    const outerHeight = Math.min(Math.max(0.62 * outerWidth, 230), 330);
    const context = prepare(this.canvas, outerWidth, outerHeight);
    const box = {
      left: PROFILE_MARGIN.left, top: PROFILE_MARGIN.top,
      width: outerWidth - PROFILE_MARGIN.left - PROFILE_MARGIN.right,
      height: outerHeight - PROFILE_MARGIN.top - PROFILE_MARGIN.bottom,
    };
    const half = field.spacing(along) / 2;
    const known = points.flatMap(({ velocity, error }) => (
      velocity.filter(Number.isFinite).flatMap((value) => [value - error, value + error])
    ));
    const [low, high] = known.length ? [Math.min(0, ...known), Math.max(0, ...known)] : [-1, 1];
    const rim = 0.06 * (high - low || 1);
    const ends = [[points[0].position - half, points[points.length - 1].position + half], [low - rim, high + rim]];
    const at = (position, value) => [
      box.left + ((position - ends[0][0]) / (ends[0][1] - ends[0][0])) * box.width,
      box.top + box.height - ((value - ends[1][0]) / (ends[1][1] - ends[1][0])) * box.height,
    ];
    context.strokeStyle = ink;
    context.lineWidth = 0.6;
    line(context, at(ends[0][0], 0), at(ends[0][1], 0));
    const style = getComputedStyle(this.canvas);
    const colours = [0, 1, 2].map((k) => style.getPropertyValue(`--series-${k}`).trim());
    colours.forEach((colour, k) => this.drawBand(context, points, k, colour, at));
    colours.forEach((colour, k) => this.drawCurve(context, points, k, colour, at));
    drawAxes(context, box, ends, [`${along} [mm]`, `velocity [${QUANTITIES.speed.unit}]`], ink);
    this.drawLegend(context, box, colours, ink);
    const others = AXES.filter((name) => name !== along).reverse();
    const where = others.map((name) => `${name} = ${fixed(field.axis[name][place[name]], 3)} mm`).join(", ");
    const mark = field.isVector ? "" : "′";
    const band = points.some(({ error }) => error > 0) ? `; bands are ± ${BAND} standard deviations` : "";
    const names = ["u", "v", "w"].map((name) => name + mark).join(", ");
    this.reading.textContent = `${names} along ${along} at ${where}${band}; open marks were replaced.`;
    this.canvas.setAttribute("aria-label", `Velocity along ${along} at ${where}`);
  }

  drawBand(context, points, k, colour, at) {
    const known = points.filter(({ velocity, error, valid }) => Number.isFinite(velocity[k]) && valid && error > 0);
    if (known.length < 2) return;
    const path = new Path2D();
    known.forEach(({ position, velocity, error }, n) => (n ? path.lineTo(...at(position, velocity[k] + error))
      : path.moveTo(...at(position, velocity[k] + error))));
    [...known].reverse().forEach(({ position, velocity, error }) => path.lineTo(...at(position, velocity[k] - error)));
    context.globalAlpha = 0.18;
    context.fillStyle = colour;
    context.fill(path);
    context.globalAlpha = 1;
  }

  /** Draw a curve, dashed differently for each component, with a mark at every vector. */
  drawCurve(context, points, k, colour, at) {
    context.strokeStyle = colour;
    context.lineWidth = 1.8;
    context.setLineDash([[], [8, 4], [2, 3]][k]);
    context.beginPath();
    let pen = false;
    for (const { position, velocity } of points) {
      const known = Number.isFinite(velocity[k]);
      if (known && pen) context.lineTo(...at(position, velocity[k]));
      else if (known) context.moveTo(...at(position, velocity[k]));
      pen = known;
    }
    context.stroke();
    context.setLineDash([]);
    const size = points.length > 60 ? 1.5 : 3;
    for (const { position, velocity, valid } of points) {
      if (!Number.isFinite(velocity[k])) continue;
      context.beginPath();
      context.arc(...at(position, velocity[k]), size, 0, 2 * Math.PI);
      context.fillStyle = colour;
      context.lineWidth = 1.2;
      if (valid) context.fill();
      else context.stroke();
    }
  }

  drawLegend(context, box, colours, ink) {
    context.textAlign = "left";
    context.textBaseline = "middle";
    ["u", "v", "w"].forEach((name, k) => {
      const left = box.left + 62 * k;
      context.strokeStyle = colours[k];
      context.lineWidth = 1.8;
      context.setLineDash([[], [8, 4], [2, 3]][k]);
      line(context, [left, box.top - 14], [left + 28, box.top - 14]);
      context.setLineDash([]);
      context.fillStyle = ink;
      context.fillText(name, left + 34, box.top - 14);
    });
  }
}
