// Plots on a canvas: time goes to the right, colours come from the style sheet, so that both themes hold.

const FONT = "12px system-ui, sans-serif";
const LEFT = 60, RIGHT = 8, TOP = 8, BOTTOM = 20;

export const colour = (name) => getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();

/** The next round number from `value` up: 1, 2 or 5 times a power of ten. */
export function roundUp(value) {
  const power = 10 ** Math.floor(Math.log10(Math.max(value, 1e-6)));
  return [1, 2, 5, 10].map((step) => step * power).find((bound) => bound >= value * 0.999);
}

/** A canvas with a time axis from `t0` to `t1` seconds and a vertical axis from `low` to `high`. */
export class Plot {
  constructor(canvas) {
    this.canvas = canvas;
  }

  /** Clears it and draws the axes; `unit` stands at the topmost number, `ticks` are times with their labels. */
  begin({ t0, t1, low, high, unit = "", ticks = [], rows = null }) {
    const ratio = devicePixelRatio || 1;
    const { clientWidth, clientHeight } = this.canvas;
    const [width, height] = [Math.round(clientWidth * ratio), Math.round(clientHeight * ratio)];
    if (this.canvas.width !== width || this.canvas.height !== height) [this.canvas.width, this.canvas.height] = [width, height];
    const pen = this.canvas.getContext("2d");
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, clientWidth, clientHeight);
    const across = clientWidth - LEFT - RIGHT, down = clientHeight - TOP - BOTTOM;
    this.x = (t) => LEFT + ((t - t0) / (t1 - t0)) * across;
    this.y = (value) => TOP + (1 - (value - low) / (high - low)) * down;
    this.area = { left: LEFT, right: LEFT + across, top: TOP, bottom: TOP + down };
    this.pen = pen;
    pen.font = FONT;
    pen.fillStyle = colour("soft");
    pen.strokeStyle = colour("line");
    pen.lineWidth = 1;
    pen.textAlign = "right";
    pen.textBaseline = "middle";
    const levels = rows ?? [0, 1, 2, 3, 4].map((step) => [low + ((high - low) * step) / 4, null]);
    levels.forEach(([value, label], index) => {
      const y = Math.round(this.y(value)) + 0.5;
      if (label === null) {
        pen.beginPath();
        pen.moveTo(LEFT, y);
        pen.lineTo(LEFT + across, y);
        pen.stroke();
      }
      const number = String(Math.round(value * 100) / 100);
      pen.fillText(label ?? (index === levels.length - 1 ? `${number} ${unit}` : number), LEFT - 5, y);
    });
    pen.textBaseline = "top";
    for (const [t, label] of ticks) {
      pen.textAlign = t === t1 ? "right" : t === t0 ? "left" : "center";
      pen.fillText(label, this.x(t), TOP + down + 5);
    }
    pen.save();
    pen.beginPath();
    pen.rect(LEFT, 0, across, TOP + down);
    pen.clip();
  }

  end() {
    this.pen.restore();
  }

  /** A line through `points` of [t, value]; broken where more than `gap` seconds lie between two. */
  line(points, name, gap) {
    const { pen } = this;
    pen.strokeStyle = colour(name);
    pen.lineWidth = 2;
    pen.beginPath();
    let before = -Infinity;
    for (const [t, value] of points) {
      if (t - before > gap) pen.moveTo(this.x(t), this.y(value));
      else pen.lineTo(this.x(t), this.y(value));
      before = t;
    }
    pen.stroke();
  }

  /** A dot at each of `points`. */
  dots(points, name, size = 2) {
    this.pen.fillStyle = colour(name);
    for (const [t, value] of points) this.pen.fillRect(this.x(t) - size / 2, this.y(value) - size / 2, size, size);
  }

  /** A cross at each of `points`. */
  crosses(points, name) {
    const { pen } = this;
    pen.strokeStyle = colour(name);
    pen.lineWidth = 1.5;
    pen.beginPath();
    for (const [t, value] of points) {
      const [x, y] = [this.x(t), this.y(value)];
      pen.moveTo(x - 3, y - 3);
      pen.lineTo(x + 3, y + 3);
      pen.moveTo(x + 3, y - 3);
      pen.lineTo(x - 3, y + 3);
    }
    pen.stroke();
  }

  /** A box from `t0` to `t1` and from `low` to `high`, at least a pixel wide. */
  box(t0, t1, low, high, name) {
    this.pen.fillStyle = colour(name);
    const x = this.x(t0);
    this.pen.fillRect(x, this.y(high), Math.max(this.x(t1) - x, 1), this.y(low) - this.y(high));
  }
}
