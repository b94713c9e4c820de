/**
 * Says that loading stands still: a download that has stopped looks like one that is slow.
 */

const PATIENCE = 10_000; // Milliseconds without anything new.

export class Standstill {
  /** @param {(words: string) => void} say */
  constructor(say) {
    this.say = say;
    this.heard = performance.now();
    this.downloading = true;
    this.timer = setInterval(() => this.look(), 1000);
  }

  /** Something has come. @param {boolean} downloading Whether more is to be downloaded. */
  note(downloading) {
    this.heard = performance.now();
    this.downloading = downloading;
  }

  /** Everything has come. */
  end() {
    clearInterval(this.timer);
  }

  look() {
    const silent = performance.now() - this.heard;
    if (silent < PATIENCE) return;
    const seconds = Math.floor(silent / 1000);
    this.say(this.downloading
      ? `The download stands still: nothing has come for ${seconds} s. Are you connected? It goes on `
        + 'by itself if it can; otherwise load the page again.'
      : `All files are here, but this browser has prepared them for ${seconds} s without a result. `
        + 'Wait a little longer, or load the page again.');
  }
}
