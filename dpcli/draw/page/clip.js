// One sequence of points: unpacking its frames, and the color of every point.

const TRAIL = 8;  // frames that stay visible when colors tell the time

class Clip {
  // about: the sequence's entry of the header. Places become multiples of `about.size` around `about.center`.
  constructor(about, bytes) {
    const { counts, low, step, center, size } = about, count = counts.reduce((sum, own) => sum + own, 0);
    this.about = about;
    this.count = count;
    this.starts = counts.reduce((all, own) => [...all, all[all.length - 1] + own], [0]);
    this.places = new Float32Array(3 * count);
    for (let axis = 0; axis < 3; axis++) {
      const lower = bytes.subarray(2 * axis * count), upper = bytes.subarray((2 * axis + 1) * count);
      const first = (low[axis] - center[axis]) / size, unit = step[axis] / size;
      for (let i = 0; i < count; i++) this.places[3 * i + axis] = first + unit * (lower[i] | (upper[i] << 8));
    }
    let at = 6 * count;
    if (about.parts.length) this.part = bytes.subarray(at, at += count);  // places in about.parts
    if (about.colored) this.stored = bytes.subarray(at, at += 3 * count);
  }

  // Height of the ground: below all but stray points.
  get floor() { return (this.about.floor - this.about.center[1]) / this.about.size; }

  // Which points are drawn at a frame: [first, count] of each span, the oldest first.
  spans(frame, kind) {
    const first = kind === "time" ? Math.max(0, frame - TRAIL + 1) : frame;
    return [[this.starts[first], this.starts[frame + 1] - this.starts[first]]];
  }

  // Colors r g b a (0..255) of all points; a is 0 where the part is hidden.
  colors(kind, header, hidden) {
    const { count, part, stored, places, about } = this, out = new Uint8Array(4 * count);
    const table = kind === "part" ? about.parts.map((one) => one.color) : [];
    const ramp = Array.from({ length: 256 }, (_, k) => ramped(header.ramp, k / 255));
    const frames = about.counts.length, [low, high] = about.heights.map((y) => (y - about.center[1]) / about.size);
    for (let frame = 0; frame < frames; frame++) {
      const moment = ramp[Math.round(255 * frame / Math.max(frames - 1, 1))];
      for (let i = this.starts[frame]; i < this.starts[frame + 1]; i++) {
        let rgb = about.label_color;
        if (kind === "part") rgb = table[part[i]];
        else if (kind === "color") rgb = stored.subarray(3 * i, 3 * i + 3);
        else if (kind === "time") rgb = moment;
        else if (kind === "height") rgb = ramp[Math.round(255 * Math.min(Math.max((places[3 * i + 1] - low) / (high - low), 0), 1))];
        out.set(rgb, 4 * i);
        out[4 * i + 3] = part && hidden.has(about.parts[part[i]].id) ? 0 : 255;
      }
    }
    return out;
  }

  // How far a point's dot reaches, such that neighbors on a surface nearly touch.
  get reach() {
    const [a, b] = about_extent(this.about).sort((one, two) => two - one);
    const usual = Math.max(this.count / this.about.counts.length, 1);
    return Math.min(Math.max(0.62 * Math.sqrt(a * b / usual), 0.004), 0.035);
  }

  // The distance from which all but a few points are within the picture, seen along the camera's axes.
  distance(camera, share = 0.9) {
    const { places, count } = this, { rotation: R, focal, width, height } = camera, needs = [], stride = Math.max(1, Math.floor(count / 20000));
    for (let i = 0; i < count; i += stride) {
      const p = [0, 1, 2].map((k) => R[3 * k] * places[3 * i] + R[3 * k + 1] * places[3 * i + 1] + R[3 * k + 2] * places[3 * i + 2]);
      needs.push(Math.max(Math.abs(p[0]) / width, Math.abs(p[1]) / height) * 2 * focal / share - p[2]);
    }
    needs.sort((a, b) => a - b);
    return needs.length ? Math.max(needs[Math.floor(0.998 * (needs.length - 1))], 0.2) : 3;
  }
}

const about_extent = ({ high, center, size }) => high.map((value, k) => 2 * (value - center[k]) / size);
