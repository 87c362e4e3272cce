// The time of a replay: which frame is shown when, and how that reads.

const TOLERANCE = 1e-6; // of a frame: sums of periods are not exact

/** Counts frames from when a replay starts to play. */
export class Clock {
  /**
   * @param {number} period seconds from frame to frame
   * @param {number} last the last frame
   */
  constructor(period, last) {
    this.period = period;
    this.last = last;
    /** @type {{ now: number, frame: number } | null} */
    this.start = null;
  }

  /** Count from the next tick on, as after a change of speed. */
  restart() {
    this.start = null;
  }

  /**
   * Return the frame to show at a tick.
   * @param {number} now milliseconds
   * @param {number} shown the frame that is shown now
   * @param {number} speed frames of the recording by frames of the clock
   */
  frameAt(now, shown, speed) {
    if (this.start === null) this.start = { now, frame: shown };
    const seconds = (now - this.start.now) / 1000;
    const played = Math.floor((seconds / this.period) * speed + TOLERANCE);
    return clampedFrame(this.start.frame + played, this.last);
  }
}

/**
 * Return the nearest frame that exists.
 * @param {number} frame
 * @param {number} last
 */
export function clampedFrame(frame, last) {
  return Math.min(last, Math.max(0, frame));
}

/**
 * Return how far along the recording a frame is, from 0 to 1.
 * @param {number} frame
 * @param {number} last
 */
export function shareOf(frame, last) {
  return frame / Math.max(last, 1);
}

/**
 * @param {number} frame
 * @param {number} period
 */
export function secondsText(frame, period) {
  return (frame * period).toFixed(1);
}

/** @param {number | null} seconds to the impact; null if there is none */
export function countdownText(seconds) {
  if (seconds === null) return "no impact";
  return seconds === 0 ? "0.0 s – impact" : `${seconds.toFixed(1)} s to impact`;
}

/**
 * Return the frame at a share of a strip.
 * @param {number} share from 0 at its left edge to 1 at its right edge
 * @param {number} last
 */
export function frameAtShare(share, last) {
  return Math.round(share * last);
}
