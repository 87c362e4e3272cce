// Saves what the replay shows as a picture: the scene, the cameras and the time, at twice the screen's size.

import { cards } from "./cameras.js";
import { data } from "./data.js";
import { byId, made } from "./elements.js";
import { map } from "./map.js";
import { space } from "./space.js";
import { state } from "./state.js";

/** @import { Card } from "./cameras.js" */

const SHARPNESS = 2; // pixels of the picture by the screen's
const GAP = 12; // pixels between the parts
const HEADING = 30; // pixels of the line above the parts
const FONT = "system-ui, sans-serif";

/**
 * A place in the picture, in the page's pixels.
 * @typedef {{ x: number, y: number, width: number, height: number }} Place
 */

/**
 * Return where an element is, relative to another one.
 * @param {Element} element
 * @param {Element} frame
 * @returns {Place}
 */
function placeIn(element, frame) {
  const { left, top, width, height } = element.getBoundingClientRect();
  const corner = frame.getBoundingClientRect();
  return { x: left - corner.left, y: top - corner.top, width, height };
}

/** @param {Place} place */
function areaOf({ x, y, width, height }) {
  return /** @type {[number, number, number, number]} */ ([x, y, width, height]);
}

/**
 * Return an image of the boxes over a camera's picture.
 * @param {SVGElement} boxes
 * @param {Place} place
 */
async function imageOfBoxes(boxes, { width, height }) {
  const copy = /** @type {SVGElement} */ (boxes.cloneNode(true));
  for (const [name, value] of Object.entries({ width, height, "font-family": FONT })) {
    copy.setAttribute(name, String(value));
  }
  const text = new XMLSerializer().serializeToString(copy);
  const image = made("img", { src: `data:image/svg+xml,${encodeURIComponent(text)}` });
  await image.decode();
  return image;
}

/** The picture while it is drawn, part by part. */
class Picture {
  /**
   * @param {number} width
   * @param {number} height
   */
  constructor(width, height) {
    const ratio = SHARPNESS * (window.devicePixelRatio || 1);
    this.canvas = made("canvas", { width: Math.round(width * ratio), height: Math.round(height * ratio) });
    const pen = this.canvas.getContext("2d");
    if (pen === null) throw new Error("this browser draws nothing on a canvas");
    this.pen = pen;
    const { backgroundColor, color } = getComputedStyle(document.body);
    this.ink = color;
    pen.scale(ratio, ratio);
    pen.fillStyle = backgroundColor;
    pen.fillRect(0, 0, width, height);
  }

  /**
   * Write words, with the middle of their height at y.
   * @param {string} words
   * @param {number} x
   * @param {number} y
   * @param {{ size?: number, color?: string, align?: CanvasTextAlign, most?: number }} look `most`: the greatest width
   */
  write(words, x, y, { size = 13, color = this.ink, align = "left", most } = {}) {
    Object.assign(this.pen, { font: `600 ${size}px ${FONT}`, fillStyle: color, textAlign: align, textBaseline: "middle" });
    this.pen.fillText(words, x, y, most);
  }

  /**
   * Write words in a box.
   * @param {string} words
   * @param {Place} place
   * @param {string} color of the box's border
   */
  writeTag(words, place, color) {
    this.pen.fillStyle = "#ffffffe6";
    this.pen.fillRect(...areaOf(place));
    Object.assign(this.pen, { strokeStyle: color, lineWidth: 1.5 });
    this.pen.strokeRect(...areaOf(place));
    const { x, y, width, height } = place;
    this.write(words, x + width / 2, y + height / 2 + 0.5, { size: 11, color: "#1c1c1c", align: "center" });
  }

  /**
   * @param {CanvasImageSource} image
   * @param {Place} place
   */
  paste(image, place) {
    this.pen.drawImage(image, ...areaOf(place));
  }

  /**
   * Draw a card of the page: the camera's picture with boxes, and its names.
   * @param {Card} card
   * @param {number} x of the cards' corner
   * @param {number} y
   */
  async addCard(card, x, y) {
    const frame = byId("cards");
    const moved = (/** @type {Element} */ element) => {
      const place = placeIn(element, frame);
      return { ...place, x: place.x + x, y: place.y + y };
    };
    const pictured = moved(card.image.parentElement ?? card.image);
    const [title] = card.figure.getElementsByClassName("name");
    const { x: left, y: top, height } = moved(title);
    this.write(card.agent.title, left, top + height / 2);
    if (card.image.hidden) this.write("no pictures", pictured.x + 8, pictured.y + 16);
    else {
      const place = moved(card.image);
      this.paste(card.image, place);
      this.paste(await imageOfBoxes(card.boxes, place), place);
    }
    if (card.where.clientWidth) this.writeTag(card.where.textContent ?? "", moved(card.where), "#ffffff");
    this.pen.fillStyle = card.agent.color;
    this.pen.fillRect(pictured.x, pictured.y, pictured.width, 4);
  }
}

/**
 * Add the scene: the parts of it that the reader chose, one below the other.
 * @param {Picture} picture
 * @param {HTMLCanvasElement[]} canvases
 */
function addScene(picture, canvases) {
  let y = HEADING + GAP;
  for (const canvas of canvases) {
    const place = { x: GAP, y, width: canvas.clientWidth, height: canvas.clientHeight };
    picture.paste(canvas, place);
    picture.pen.strokeStyle = data.colors.grid;
    picture.pen.strokeRect(...areaOf(place));
    if (canvas === space.canvas) {
      for (const tag of byId("space-names").children) {
        const { x, y: top, width, height } = placeIn(tag, canvas);
        const color = getComputedStyle(tag).borderColor;
        picture.writeTag(tag.textContent ?? "", { x: x + GAP, y: y + top, width, height }, color);
      }
    }
    y += canvas.clientHeight + GAP;
  }
}

/** Draw what the page shows at the frame. */
async function drawPicture() {
  const canvases = [space.canvas, map.canvas].filter((canvas) => canvas.clientWidth);
  const frame = byId("cards");
  const sceneWidth = canvases[0].clientWidth;
  const sceneHeight = canvases.reduce((sum, canvas) => sum + canvas.clientHeight + GAP, -GAP);
  const width = sceneWidth + frame.clientWidth + 3 * GAP;
  const places = cards.map((card) => placeIn(card.image.parentElement ?? card.image, frame));
  const cardsHeight = Math.max(...places.map(({ y, height }) => y + height));
  const picture = new Picture(width, HEADING + 2 * GAP + Math.max(sceneHeight, cardsHeight));
  const words = [data.scenario, byId("time").textContent, byId("countdown").textContent];
  picture.write(words.filter(Boolean).join("   "), GAP, GAP + HEADING / 2, { size: 16, most: width - 2 * GAP });
  state.sharpness = SHARPNESS;
  try {
    map.draw();
    space.drawNow();
    addScene(picture, canvases);
  } finally {
    state.sharpness = 1;
    map.draw();
    space.draw();
  }
  for (const card of cards) await picture.addCard(card, sceneWidth + 2 * GAP, HEADING + GAP);
  return picture.canvas;
}

/** Save what the page shows at the frame as a PNG file. */
export async function savePicture() {
  const name = `${data.scenario.replaceAll("/", "_")}_${String(state.frame + 1).padStart(3, "0")}.png`;
  const canvas = await drawPicture();
  canvas.toBlob((file) => {
    if (file === null) return;
    const address = URL.createObjectURL(file);
    made("a", { href: address, download: name }).click();
    setTimeout(() => URL.revokeObjectURL(address), 10_000); // some browsers read it after the click
    byId("announcement").textContent = `Saved ${name}`;
  }, "image/png");
}
