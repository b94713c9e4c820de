/**
 * The worker: owns simulators, OpenGL and networks; takes commands, answers with frames.
 *
 * One loop does everything in turn, so nobody sees half a step: obey what has come, take a decision
 * if it is time, show it. What is said by whom to whom is in `messages.js`.
 */
import {Stage} from './stage.js';

const stage = new Stage((answer, buffers = []) => {
  // What a worker posts is typed by its page; `self` is a window to the type checker.
  /** @type {any} */ (self).postMessage(answer, buffers);
});

self.onmessage = event => stage.send(event.data);
stage.run();
