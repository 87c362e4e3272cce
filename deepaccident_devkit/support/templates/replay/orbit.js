// Where the reader's eye is: it looks at a place, from a direction and a distance. Metres and radians; z points up.

const LENS = 0.9; // radians from the picture's lower to its upper edge
const CLOSEST = 4; // metres
const FARTHEST = 900;
const LOWEST = 0.05;
const ABOVE = Math.PI / 2;

const cross = (one, other) => [
  one[1] * other[2] - one[2] * other[1],
  one[2] * other[0] - one[0] * other[2],
  one[0] * other[1] - one[1] * other[0],
];

class Orbit {
  constructor() {
    this.target = [0, 0, 0];
    this.turn = -Math.PI / 2; // from which side
    this.rise = 0.6; // from how high
    this.distance = 60;
  }

  // Right, up and ahead of the eye; also straight from above they are what they should be.
  get axes() {
    const [cos, sin] = [Math.cos(this.turn), Math.sin(this.turn)];
    const ahead = [-cos * Math.cos(this.rise), -sin * Math.cos(this.rise), -Math.sin(this.rise)];
    const right = [-sin, cos, 0];
    return [right, cross(right, ahead), ahead];
  }

  get eye() {
    const ahead = this.axes[2];
    return this.target.map((each, axis) => each - ahead[axis] * this.distance);
  }

  turnBy(right, up) {
    this.turn -= right;
    this.rise = Math.min(ABOVE, Math.max(LOWEST, this.rise + up));
  }

  closer(factor) {
    this.distance = Math.min(FARTHEST, Math.max(CLOSEST, this.distance / factor));
  }

  // Move along the ground by pixels of a picture of this height.
  move(right, down, height) {
    const metres = (2 * this.distance * Math.tan(LENS / 2)) / height;
    const [cos, sin] = [Math.cos(this.turn), Math.sin(this.turn)];
    this.target[0] += metres * (sin * right - cos * down);
    this.target[1] += metres * (-cos * right - sin * down);
  }

  // By columns: from world to the corners of the picture, -1 to 1.
  matrix(aspect) {
    const [right, up, ahead] = this.axes;
    const eye = this.eye;
    const zoom = 1 / Math.tan(LENS / 2);
    const [near, far] = [Math.max(0.2, this.distance / 200), this.distance + 1000];
    const rows = [
      [...right.map((each) => (each * zoom) / aspect), (-dot(right, eye) * zoom) / aspect],
      [...up.map((each) => each * zoom), -dot(up, eye) * zoom],
      [...ahead, -dot(ahead, eye)].map((each) => (each * (far + near)) / (far - near)),
      [...ahead, -dot(ahead, eye)],
    ];
    rows[2][3] -= (2 * far * near) / (far - near);
    return new Float32Array([0, 1, 2, 3].flatMap((column) => rows.map((row) => row[column])));
  }

  // The direction of what a pixel shows; of length 1 along the middle of the picture.
  ray(x, y, width, height) {
    const [right, up, ahead] = this.axes;
    const half = Math.tan(LENS / 2);
    const [across, high] = [((2 * x) / width - 1) * half * (width / height), (1 - (2 * y) / height) * half];
    return ahead.map((each, axis) => each + across * right[axis] + high * up[axis]);
  }

  // The pixel of a place; null behind the eye.
  pixel(place, width, height) {
    const away = place.map((each, axis) => each - this.eye[axis]);
    const [across, high, deep] = this.axes.map((axis) => dot(axis, away));
    if (deep < 0.3) return null;
    const zoom = height / 2 / Math.tan(LENS / 2) / deep;
    return [width / 2 + across * zoom, height / 2 - high * zoom];
  }
}
