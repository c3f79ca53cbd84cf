// One sequence of points: unpacking its frames, and the color of every point.

const GHOSTS = 7;  // earlier moments that stay visible when colors tell the time
const STRAY = 0.001;  // share of the points beyond each side of the box that counts

// The turn, as rows, that lets a direction of the page (along an axis) point up.
function uprightTurn([x, y, z]) {
  if (Math.abs(y) > 0.5) return [[1, 0, 0], [0, y, 0], [0, 0, y]];
  return Math.abs(z) > 0.5 ? [[1, 0, 0], [0, 0, z], [0, -z, 0]] : [[0, -x, 0], [x, 0, 0], [0, 0, 1]];
}
const times = (rows, v) => rows.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);

class Clip {
  // about: the sequence's entry of the header. turn: rows of a rotation. `places` are multiples of `size` around `center`.
  constructor(about, bytes, turn) {
    const { counts } = about, count = counts.reduce((sum, own) => sum + own, 0);
    Object.assign(this, { about, bytes, count });
    this.starts = counts.reduce((all, own) => [...all, all[all.length - 1] + own], [0]);
    this.usual = Math.max(count / counts.length, 1);  // points of a frame
    this.unpack(turn);
    this.enclose();
    let at = 6 * count;
    if (about.parts.length) this.part = bytes.subarray(at, at += count);  // places in about.parts
    if (about.colored) this.stored = bytes.subarray(at, at += 3 * count);
  }

  unpack(turn) {
    const { count, bytes, about: { low, step } } = this, planes = [0, 1, 2, 3, 4, 5].map((k) => bytes.subarray(k * count, (k + 1) * count));
    this.places = new Float32Array(3 * count);
    for (let i = 0; i < count; i++) {
      const given = [0, 1, 2].map((k) => low[k] + step[k] * (planes[2 * k][i] | (planes[2 * k + 1][i] << 8)));
      this.places.set(times(turn, given), 3 * i);
    }
  }

  // Finds the box of all but stray points, and makes its half diagonal the unit.
  enclose() {
    const { places, count } = this, stride = Math.max(1, Math.floor(count / 50000)), ends = [0, 1, 2].map((axis) => {
      const some = new Float32Array(Math.ceil(count / stride)).map((_, k) => places[3 * k * stride + axis]).sort(), last = some.length - 1;
      return last < 0 ? [0, 0] : [some[Math.ceil(STRAY * last)], some[Math.floor((1 - STRAY) * last)]];
    });
    this.center = ends.map(([low, high]) => (low + high) / 2);
    this.size = Math.hypot(...ends.map(([low, high]) => high - low)) / 2 || 1;
    this.half = ends.map(([low, high]) => (high - low) / 2 / this.size);
    for (let i = 0; i < 3 * count; i++) places[i] = (places[i] - this.center[i % 3]) / this.size;
  }

  get floor() { return -this.half[1]; }

  // Which points are drawn at a frame: [first, count] of each span, the newest last. For the time, frames before it, too.
  spans(frame, kind) {
    const apart = Math.max(1, Math.round(this.about.counts.length / (GHOSTS + 1))), found = [];
    for (let k = kind === "time" ? GHOSTS : 0; k >= 0; k--) {
      const at = frame - k * apart;
      if (at >= 0) found.push([this.starts[at], this.about.counts[at]]);
    }
    return found;
  }

  // Colors r g b a (0..255) of all points; a is 0 where the part is hidden.
  colors(kind, header, hidden) {
    const { count, part, stored, places, about } = this, out = new Uint8Array(4 * count);
    const table = kind === "part" ? about.parts.map((one) => one.color) : [];
    const ramp = Array.from({ length: 256 }, (_, k) => ramped(header.ramp, k / 255));
    const frames = about.counts.length, tall = 2 * this.half[1] || 1;
    for (let frame = 0; frame < frames; frame++) {
      const moment = ramp[Math.round(255 * frame / Math.max(frames - 1, 1))];
      for (let i = this.starts[frame]; i < this.starts[frame + 1]; i++) {
        let rgb = about.label_color;
        if (kind === "part") rgb = table[part[i]];
        else if (kind === "color") rgb = stored.subarray(3 * i, 3 * i + 3);
        else if (kind === "time") rgb = moment;
        else if (kind === "height") rgb = ramp[Math.round(255 * Math.min(Math.max((places[3 * i + 1] - this.floor) / tall, 0), 1))];
        out.set(rgb, 4 * i);
        out[4 * i + 3] = part && hidden.has(about.parts[part[i]].id) ? 0 : 255;
      }
    }
    return out;
  }

  // How far a point's dot reaches, such that neighbors on a surface nearly touch.
  get reach() {
    const [a, b] = this.half.map((value) => 2 * value).sort((one, two) => two - one);
    return Math.min(Math.max(0.55 * Math.sqrt(a * b / this.usual), 0.1 / Math.sqrt(this.usual), 0.004), 0.03);
  }

  // Half the side of the ground, and of its squares, whose size is round in the file's unit.
  get ground() {
    const wide = Math.max(this.half[0], this.half[2], 0.55), square = roundBelow(wide * this.size / 3.5) / this.size;
    return { square, side: square * Math.ceil(wide / square + 0.2) };
  }

  // The distance from a target from which all but a few points, and the ground, are within the picture.
  distance(camera, target) {
    const { places, count, floor, ground: { side } } = this, { rotation: R, focal, width, height } = camera, needs = [];
    const need = (x, y, z, share) => {
      const p = [0, 1, 2].map((k) => R[3 * k] * (x - target[0]) + R[3 * k + 1] * (y - target[1]) + R[3 * k + 2] * (z - target[2]));
      return Math.max(Math.abs(p[0]) / width, Math.abs(p[1]) / height) * 2 * focal / share - p[2];
    };
    for (let i = 0, stride = Math.max(1, Math.floor(count / 20000)); i < count; i += stride) needs.push(need(places[3 * i], places[3 * i + 1], places[3 * i + 2], 0.9));
    needs.sort((a, b) => a - b);
    const corners = [-side, side].flatMap((x) => [-side, side].map((z) => need(x, floor, z, 0.97)));
    return Math.max(needs.length ? needs[Math.floor(0.998 * (needs.length - 1))] : 3, ...corners, 0.2);
  }
}

// The largest of 1, 2, 5, 10, ... that is not above `most`.
function roundBelow(most) {
  const power = 10 ** Math.floor(Math.log10(most)), digit = [5, 2, 1].find((one) => one * power <= most * (1 + 1e-9)) || 1;
  return digit * power;
}
