/**
 * What page and worker say to each other: commands in, frames out.
 *
 * One worker owns simulators, OpenGL contexts and networks, as one thread does on the server. The
 * page sends it a `Command` by `worker.postMessage`, and gets an `Answer` back by `onmessage`.
 * Names are those of `madviz/session/commands.py` and `frame.py`, so that whoever knows one knows
 * the other; fields keep their Python spelling for the same reason. This file has types alone.
 *
 *     Open ─► Progress … ─► Ready ─► Frame, Frame, … (a command takes effect in the next decision)
 *
 * Axis letters: V streams, N subsets, Z feature (3136), A action (4), H W rows and columns (84).
 * Metres, degrees and seconds, if nothing else is said.
 */

// --- Cameras ------------------------------------------------------------------------------------

/**
 * How a camera fails; all numbers are shares in [0, 1]. A patch has its middle at (x, y).
 * @typedef {object} Occlusion
 * @property {'none' | 'black' | 'noise' | 'freeze' | 'blur' | 'patch'} kind
 * @property {number} strength
 * @property {number} x
 * @property {number} y
 * @property {number} width
 * @property {number} height
 */

/**
 * A camera's switch: which modalities count, `off` is dropped; and how it fails.
 * @typedef {object} CameraState
 * @property {'rgb' | 'depth' | 'both' | 'off'} input
 * @property {Occlusion} occlusion
 */

/**
 * How far a camera is from where it was in training, along its own axes; zoom 1 is none.
 * Metres from -1 to 1, degrees from -90 to 90, zoom from 0.5 to 2.
 * @typedef {object} Displacement
 * @property {number} forward
 * @property {number} right
 * @property {number} up
 * @property {number} pan
 * @property {number} tilt
 * @property {number} zoom
 */

/**
 * Where a camera is now. `wxyz` has OpenCV axes: x right, y down, looking along +z.
 * @typedef {object} CameraPose
 * @property {[number, number, number]} position
 * @property {[number, number, number, number]} wxyz
 * @property {number} fovy
 */

// --- Commands: page to worker -------------------------------------------------------------------

/**
 * Which simulation is meant. Where `Open` names no second policy, there is `first` alone.
 * @typedef {'first' | 'second' | 'both'} Side
 */

/**
 * The first command: where the site's folder is, and what plays first. `base` is an absolute
 * address that ends with a slash; nothing outside it is ever fetched. `events` are as in SetSchedule,
 * and no guard watches but from them. Where it fails, all stays as it is.
 * @typedef {{kind: 'Open', base: string, policy: string, seed: number, second?: string | null,
 *   events?: ScheduledEvent[]}} Open
 */
/** @typedef {{kind: 'SetCamera', side: Side, camera: string, state: CameraState}} SetCamera */
/**
 * A camera stands elsewhere from now on; null puts it back.
 * @typedef {{kind: 'MoveCamera', side: Side, camera: string, move: Displacement | null}} MoveCamera
 */
/**
 * Starts the episode of this seed, one of the task's in the manifest.
 * @typedef {{kind: 'SetSeed', seed: number}} SetSeed
 */
/** @typedef {{kind: 'Play'}} Play */
/** @typedef {{kind: 'Pause'}} Pause */
/** @typedef {{kind: 'StepOnce'}} StepOnce */
/**
 * Starts again: the same seed, or the next one.
 * @typedef {{kind: 'Reset', next_seed: boolean}} Reset
 */
/**
 * Decisions per second; null: as fast as it goes.
 * @typedef {{kind: 'SetSpeed', rate: number | null}} SetSpeed
 */
/**
 * Whether the next seed starts by itself some seconds after an episode is over.
 * @typedef {{kind: 'SetAutoNext', on: boolean}} SetAutoNext
 */
/**
 * Whether a camera that fails is noticed and left out, on all sides whose policy has a fitted guard;
 * from the next decision on, whatever a schedule said.
 * @typedef {{kind: 'SetGuard', on: boolean}} SetGuard
 */
/**
 * Failures that come by themselves at a step, in this episode and all that follow; an empty list
 * ends them. They begin again with every episode, where all cameras that it names work at step 0,
 * and no guard watches if it names the guard.
 * @typedef {{kind: 'SetSchedule', events: ScheduledEvent[]}} SetSchedule
 * @typedef {CameraEvent & {side: Side}} ScheduledEvent The guard's are of both sides.
 */
/**
 * After how many decisions action and Q of all subsets are read once more; 0: never, 1: always.
 * The readout of the newest frame comes at once.
 * @typedef {{kind: 'SetReadout', every: number}} SetReadout
 */
/**
 * Plays this many episodes as fast as the machine can, from the next seed on, under the present
 * switches (schedules included); `Run` answers come meanwhile, and few frames.
 * @typedef {{kind: 'RunMany', episodes: number}} RunMany
 */
/** @typedef {{kind: 'StopRun'}} StopRun */
/**
 * Asks for the episodes played here as a saved session; a `Saved` answer comes.
 * @typedef {{kind: 'Save'}} Save
 */
/**
 * Plays an episode of a saved session again: its policy, seed, switches at their steps. Files come
 * from anybody: an `Problem` answer says what is wrong with one, and what was played stays.
 * @typedef {{kind: 'Replay', text: string, episode?: number}} Replay
 */
/**
 * The page was hidden or is shown again; a hidden page's simulation stands still.
 * @typedef {{kind: 'SetVisible', on: boolean}} SetVisible
 */

/**
 * @typedef {Open | SetCamera | MoveCamera | SetSeed | Play | Pause | StepOnce | Reset
 *   | SetSpeed | SetAutoNext | SetGuard | SetSchedule | SetReadout | RunMany | StopRun | Save
 *   | Replay | SetVisible} Command
 */

// --- Answers: worker to page --------------------------------------------------------------------

/**
 * What is being fetched or made ready; `done` of `of` bytes, as they come over the wire, of all
 * files that are needed for the first decision.
 * @typedef {{kind: 'Progress', what: string, done: number, of: number}} Progress
 */
/**
 * The first decision of every side has been made; the switches of the schedule are still to come.
 * @typedef {{kind: 'Ready', seconds: number, backend: string, events: ScheduledEvent[]}} Ready
 */
/**
 * Something went wrong, in one sentence. `fatal`: nothing will move any more ('WebGL2 is missing');
 * otherwise what played before goes on. `refused`: the browser or the host does not let it run.
 * @typedef {{kind: 'Problem', message: string, fatal: boolean, refused?: boolean}} Problem
 */
/** @typedef {{kind: 'Saved', text: string}} Saved */
/**
 * The scene of a task that is shown for the first time, for `parseScene`.
 * @typedef {{kind: 'Scene', task: string, buffer: ArrayBuffer, textures: ArrayBuffer[]}} SceneFiles
 */
/**
 * How `RunMany` stands; `outcomes` are all of this run so far.
 * @typedef {{kind: 'Run', done: number, of: number, ended: boolean, outcomes: Outcome[]}} Run
 */

/**
 * A picture: H rows from the top of W pixels of 4 bytes; ready for `new ImageData`.
 * @typedef {object} Picture
 * @property {number} width
 * @property {number} height
 * @property {Uint8ClampedArray} rgba
 */

/**
 * How an episode ended.
 * @typedef {object} Outcome
 * @property {Side} side
 * @property {string} policy
 * @property {number} seed
 * @property {boolean} success At the last step.
 * @property {boolean} success_any At any step.
 * @property {Condition | null} condition If it was the same from the first step to the last.
 */

/**
 * What the policy was given: present streams as `all`, `none` or `first+third_a`; and the
 * occlusions and moves in `Ablation.key()`'s words, '' for none; and whether a guard watched.
 * @typedef {{subset: string, occlusions: string, guarded?: boolean}} Condition
 */

/**
 * What a policy would do under each of N subsets, at `step`.
 * @typedef {object} Readout
 * @property {number} step
 * @property {string[]} subsets (N)
 * @property {Float32Array} action (N x A)
 * @property {Float32Array} q (N)
 */

/**
 * What was just done to a camera, and what came of it at that time step.
 * @typedef {object} Change
 * @property {string} camera
 * @property {CameraState} before
 * @property {CameraState} after
 * @property {boolean} moved
 * @property {boolean} [home] It was put back in its place.
 * @property {number} step
 * @property {number} action_change Euclidean distance between the two actions.
 * @property {number} q_before
 * @property {number} q_after
 */

/**
 * One time step of one simulation.
 * @typedef {object} World
 * @property {string} policy
 * @property {string} task
 * @property {number} episode Grows with every episode.
 * @property {number} seed
 * @property {number} step Decisions taken in this episode.
 * @property {number} horizon Decisions in an episode.
 * @property {Record<string, CameraState>} cameras The switches of every camera.
 * @property {Record<string, Displacement>} moves The cameras that do not stand where they did.
 * @property {Condition} condition
 * @property {Condition} [decided] The condition of the last decision.
 * @property {Record<string, Picture>} arrived By stream, what reached the policy.
 * @property {Record<string, CameraPose>} poses By camera.
 * @property {Float32Array} geom_poses (G x 12): what `pictures.js` draws, for the orbit view: three
 *   numbers of position and nine of rotation, row by row, in the order of the scene's shapes.
 * @property {Picture} [scene] Of a recording: the scene as it was seen from outside.
 * @property {Float32Array} norms (V) of the features, in the order of `streams`.
 * @property {string[]} streams
 * @property {boolean[]} mask (V) The streams that are present, and that the guard does not leave out.
 * @property {Noticed[] | null} guard The cameras that it leaves out; null where no guard watches.
 * @property {Float32Array} merged (Z) under the present switches.
 * @property {Float32Array} action (A) what it does next, in [-1, 1].
 * @property {number} q
 * @property {Readout | null} readout The newest one; its `step` says how old it is.
 * @property {boolean} success At this very step.
 * @property {boolean} success_any
 * @property {boolean} ended
 * @property {Change | null} change The last thing done to a camera in this episode.
 * @property {CameraEvent[]} events What was done to cameras in this episode, in order; at step 0,
 *   how it began.
 * @property {HandPaths | null} [paths] After an episode in which a camera was changed, once its replay
 *   with all cameras is done and was exact.
 */

/**
 * The hand's path from the first change of a camera on, and its path with all cameras: (T x 3) metres.
 * @typedef {{since: number, taken: Float32Array, intact: Float32Array}} HandPaths
 */

/** A camera that a guard has found to fail, and the step of the episode at which it was noticed.
 * @typedef {{camera: string, kind: import('./guard.js').Kind, since: number, why: string}} Noticed */

/**
 * A state, a move, or that a guard watches from here on or no more; `camera` is '' then.
 * @typedef {{step: number, camera: string, state?: CameraState, move?: Displacement | null,
 *   guard?: boolean}} CameraEvent
 */

/**
 * One time step of all sides, complete. Array buffers are transferred, so they belong to the page.
 * @typedef {object} Frame
 * @property {'Frame'} kind
 * @property {number} number Grows with every frame.
 * @property {'playing' | 'paused' | 'ended' | 'running'} phase `running`: `RunMany`.
 * @property {number | null} speed Decisions per second asked for.
 * @property {number} rate Decisions per second achieved, of each side; NaN until it is known.
 * @property {boolean} auto_next
 * @property {World} first
 * @property {World | null} second
 * @property {Outcome[]} outcomes The last live episodes of all sides, oldest first, 200 at most.
 */

/** @typedef {Progress | Ready | Problem | Saved | SceneFiles | Run | Frame} Answer */

// --- Files --------------------------------------------------------------------------------------

/**
 * A gzipped file of the site: `path` from the site's folder, bytes as sent and as unpacked.
 * @typedef {{path: string, bytes: number, unpacked: number}} SiteFile
 */

/**
 * A camera as `madviz.types.CameraSpec` has it; `wxyz` has OpenGL axes here (x right, y up,
 * looking along -z), as in `config.json` of a policy.
 * @typedef {object} CameraSpec
 * @property {string} name
 * @property {string} label
 * @property {number} fovy
 * @property {[number, number, number]} position
 * @property {[number, number, number, number]} wxyz
 * @property {string | null} body
 * @property {[number, number]} depth_range
 * @property {number} size
 */

/**
 * A success rate as it was measured with madviz (`where: 'server'`) or with this site in a browser.
 * @typedef {{success: number, n: number, ci95: [number, number], trained: boolean}} Rate
 */

/**
 * @typedef {object} SitePolicy
 * @property {string} name
 * @property {string} label For example `MAD` or `Merged Only`.
 * @property {string} task
 * @property {string} method
 * @property {string} setting
 * @property {string[]} streams In the order of axis V.
 * @property {string[]} trained_subsets
 * @property {string} digest
 * @property {CameraSpec[]} cameras
 * @property {Record<string, Rate>} measured By subset.
 * @property {string} seeds Which seeds `measured` was counted on, in words.
 * @property {SiteFile} graph
 * @property {SiteFile} [guard] The fitted values of its guard, where it has one.
 * @property {string} [guarded_digest] Of the policy with its guard.
 */

/**
 * @typedef {object} SiteTask
 * @property {string} name For example `metaworld/hammer`.
 * @property {string} label For example `Hammer`.
 * @property {string} success When it is a success, in words.
 * @property {[string, string]} done What who succeeds does: `drive the nail in`, and in the past.
 * @property {number} horizon Decisions in an episode.
 * @property {number} action_repeat
 * @property {[number[], number[]]} reach Where the hand can go: low and high, metres.
 * @property {number[]} seeds
 * @property {SiteFile} model
 * @property {SiteFile} scene
 * @property {SiteFile[]} textures
 * @property {SiteFile} starts
 */

/**
 * Recorded episodes of a policy, each whole under one subset of cameras: for tasks that no browser
 * can simulate, and for browsers that cannot simulate.
 * @typedef {object} SiteRecording
 * @property {string} policy
 * @property {string} label For example `MAD`.
 * @property {string} method
 * @property {string} task
 * @property {string} task_label
 * @property {string} success When it is a success, in words.
 * @property {[string, string]} done What who succeeds does: `drive the nail in`, and in the past.
 * @property {number} horizon Decisions in an episode.
 * @property {string[]} streams
 * @property {string[]} trained_subsets
 * @property {CameraSpec[]} cameras
 * @property {Record<string, Rate>} measured By subset.
 * @property {string} seeds_words Which seeds `measured` was counted on: `development seeds`.
 * @property {number[]} seeds That were recorded.
 * @property {Record<string, SiteFile>} files By `seed/subset`, for example `5000/first+third_a`.
 */

/**
 * `manifest.json`, the only file that is not gzipped.
 * @typedef {object} Manifest
 * @property {1} schema
 * @property {number} page_bytes Of the files of the page itself, which are not gzipped.
 * @property {string} version Of madviz.
 * @property {Record<string, string>} versions Of the packages that made it and that run in it.
 * @property {{first: string, second: string, camera: string, step: number, seed: number} | null
 *   } opening What is shown first: two policies side by side, and which camera goes when.
 * @property {SiteTask[]} tasks
 * @property {SitePolicy[]} policies
 * @property {SiteRecording[]} recordings
 * @property {Record<RuntimeName, SiteFile>} runtime
 * @property {Record<string, string>} [meanings] Words of the page, and what they mean.
 * @typedef {'mujoco.js' | 'mujoco.wasm' | 'ort.js' | 'ort_glue.js' | 'ort.wasm'} RuntimeName
 */

export {}
