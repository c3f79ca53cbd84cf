// Trajectories: where some Gaussians were and will be, as lines over the picture that fade with the distance in time.

const TRAILS = 240, AROUND = 12;  // lines at most; frames before and after the one that is shown

class Trails {
  constructor(canvas, scene) {
    Object.assign(this, { canvas, scene, context: canvas.getContext("2d") });
    const { count, color } = scene, opaque = [];
    for (let i = 0; i < count; i++) if (color[3 * count + i] > 127) opaque.push(i);
    const step = Math.max(1, opaque.length / TRAILS);
    this.chosen = Array.from({ length: Math.min(TRAILS, opaque.length) }, (_, k) => opaque[Math.floor(k * step)]);
    this.tints = new Map(scene.header.parts.map((part) => [part.id + 1, part.color]));
  }

  draw(shown, camera, hidden) {
    const { canvas, context, scene } = this;
    if (!shown && canvas.hidden) return;
    canvas.hidden = !shown;
    if (!shown) return;
    Object.assign(canvas, { width: camera.width, height: camera.height });  // clears it, too
    context.lineWidth = Math.max(1, camera.height / 600);
    const [now] = scene.timeline.between(scene.now), first = Math.max(0, now - AROUND), last = Math.min(scene.frames - 1, now + AROUND);
    for (const i of this.chosen) if (!hidden.has(scene.part[i])) this.line(i, first, last, now, camera);
  }

  line(i, first, last, now, camera) {
    const { context, scene } = this, tint = this.tints.get(scene.part[i]);
    let before = null;
    for (let frame = first; frame <= last; frame++) {
      const pixel = projected(scene.placeAt(i, frame), camera);
      if (before && pixel) {
        context.strokeStyle = `rgba(${tint},${1 - Math.abs(frame - now) / (AROUND + 1)})`;
        context.beginPath();
        context.moveTo(...before);
        context.lineTo(...pixel);
        context.stroke();
      }
      before = pixel;
    }
  }
}

// The pixel of a point, or null behind the camera.
function projected([a, b, c], { rotation: R, shift, focal, width, height, near }) {
  const [x, y, z] = [0, 3, 6].map((k) => R[k] * a + R[k + 1] * b + R[k + 2] * c + shift[k / 3]);
  return z < near ? null : [width / 2 + focal * x / z, height / 2 + focal * y / z];
}
