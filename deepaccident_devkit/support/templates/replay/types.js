// The types of a replay: of the data that `render/replay/page.py` writes into the page, and of what the scripts share.

// geometry

/** @typedef {[x: number, y: number, z: number]} Vector */
/** @typedef {[x: number, y: number]} Point centimetres from the page's origin, y to the north */
/** @typedef {readonly [x: number, y: number, ...rest: (number | null)[]]} Place anything that begins with a point */
/** @typedef {[x: number, y: number]} Pixel */
/** @typedef {[left: number, top: number, right: number, bottom: number]} Rectangle pixels */
/** @typedef {[x: Vector, y: Vector, z: Vector]} Axes three unit vectors at right angles */
/** @typedef {[red: number, green: number, blue: number]} Color from 0 to 1 */

// the data of the page

/**
 * Where an agent is: x and y (cm), yaw (mrad).
 * @typedef {[x: number, y: number, yaw: number]} AgentPose
 */

/**
 * Where an actor is: x and y of its centre (cm), yaw (mrad), speed (dm/s; null if it is unknown), z of its centre (cm),
 * and x and y of the upward axis of its box (thousandths).
 * @typedef {[x: number, y: number, yaw: number, speed: number | null, z: number, upX: number, upY: number]} ActorState
 */

/**
 * The pose world_from_camera, with optical axes: x, y and z (cm), and a unit quaternion (ten thousandths).
 * @typedef {[x: number, y: number, z: number, qw: number, qx: number, qy: number, qz: number]} CameraPose
 */

/**
 * Width and height of the image, focal lengths and principal point (pixels).
 * @typedef {[width: number, height: number, fx: number, fy: number, cx: number, cy: number]} Lens
 */

/**
 * A vehicle or a pole that records; `actor` is the id of the actor that it is.
 * @typedef {object} Agent
 * @property {string} name
 * @property {string} title
 * @property {string} short its letters
 * @property {string} color
 * @property {number | null} actor
 * @property {AgentPose[]} poses one for each frame
 */

/**
 * A road user with a box; `length`, `width` and `height` are centimetres.
 * @typedef {object} Actor
 * @property {number} id
 * @property {string} title
 * @property {string} category
 * @property {"pair" | "agent" | "other"} role
 * @property {string} tag the letters of the agent that it is, or empty
 * @property {string} color
 * @property {number} length
 * @property {number} width
 * @property {number} height
 * @property {(ActorState | null)[]} states one for each frame; null where it is not annotated
 * @property {number[]} seen for each frame a bit mask over the agents that see it
 */

/**
 * A camera of an agent. A picture is JPEG in base64, or 1 where a server has it; null where there is none.
 * @typedef {object} Camera
 * @property {string} title
 * @property {Lens} lens
 * @property {CameraPose[]} poses one for each frame
 * @property {(string | 1 | null)[]} pictures one for each frame
 * @property {string} [channel] its name on the server
 */

/**
 * What a task draws of an agent's prediction at a frame, and what that counts as.
 * @typedef {object} Sample
 * @property {number} frame
 * @property {number} agent number in the list of agents
 * @property {string} verdict
 * @property {string} color of the verdict
 * @property {string} text
 * @property {number} more how many lines are left out
 * @property {DrawnLine[]} lines
 * @property {DrawnPlace[]} places
 * @property {{ score: number, fires: boolean } | null} alarm
 */

/**
 * A path, or the outline of a box or shape; `width` (metres) is that of a ribbon.
 * @typedef {object} DrawnLine
 * @property {Point[]} points
 * @property {string} color
 * @property {number} [opacity] from 0 to 1
 * @property {number} [width]
 * @property {boolean} dashed
 * @property {boolean} [filled]
 * @property {[first: number, last: number]} [frames] that it is predicted for; all if there are none
 */

/**
 * Points where something happens `time` seconds after the sample.
 * @typedef {object} DrawnPlace
 * @property {Point[]} points
 * @property {number} time
 * @property {string} note
 * @property {string} label
 * @property {string} color
 */

/**
 * The picture of the road (PNG in base64), and where it lies (cm).
 * @typedef {object} Road
 * @property {string} png
 * @property {number} left
 * @property {number} top
 * @property {number} width
 * @property {number} height
 */

/**
 * @typedef {object} Colors
 * @property {string} pair
 * @property {string} points
 * @property {string} grid
 * @property {string[]} heights from low to high
 */

/**
 * Where a server has pictures and points: the folder's address and, for each agent and frame, whether there are points.
 * @typedef {object} Served
 * @property {string} folder
 * @property {(boolean[] | null)[]} points
 */

/**
 * All that a page shows of a scenario.
 * @typedef {object} ReplayData
 * @property {string} scenario
 * @property {[name: string, value: string][]} facts
 * @property {number} period seconds from frame to frame
 * @property {(number | null)[]} countdown seconds to the impact at each frame
 * @property {Point | null} impact
 * @property {Colors} colors
 * @property {Record<string, string>} markers category to marker, as matplotlib names them
 * @property {Agent[]} agents
 * @property {Actor[]} actors the colliding pair first
 * @property {{ gap: (number | null)[], ttc: (number | null)[] } | null} pair gap (cm) and time to collision (ds)
 * @property {Road | null} road
 * @property {{ rule: string, samples: Sample[], legend: [label: string, color: string][] } | null} prediction
 * @property {Camera[][]} cameras those of each agent
 * @property {number[]} files how many sensor files each frame has
 * @property {number} sensors how many it would have
 * @property {{ agents: number[], cameras: string[][] }} automatic the agent and each agent's camera that show the pair
 *   best at each frame
 * @property {((string | null)[] | null)[] | null} points for each agent and frame a point cloud in base64
 * @property {string[]} notes
 * @property {Served} [served]
 */

// the state of the page

/** @typedef {"both" | "space" | "map"} Scene */

/**
 * What the reader has chosen. Numbers of agents are texts, as those of the options of a <select>.
 * @typedef {object} PageState
 * @property {number} frame from 0
 * @property {boolean} playing
 * @property {number} speed
 * @property {string} follow number of an agent, "pair", or empty for nobody
 * @property {string} sight number of an agent, "all", or empty for none
 * @property {string} large number of the agent with the large picture; empty for automatic
 * @property {boolean} boxes
 * @property {Record<string, boolean>} layers
 * @property {number[]} clouds numbers of the agents whose points are shown
 * @property {"agent" | "height"} pointsBy
 * @property {Scene} scene
 * @property {number | null} pointed id of the actor under the pointer
 * @property {number | null} chosen id of the actor that was clicked
 * @property {number | null} lit id of the actor that all views highlight: pointed at, or else chosen
 * @property {Sample[]} foreseen the samples of the last evaluated frame
 * @property {boolean} held whether these stay when time goes on
 * @property {number} sharpness pixels of the scene's drawings by the screen's
 */

/**
 * A view of the scene that the pages around can set, in the numbers of its canvas' `data-view`.
 * @typedef {object} SceneView
 * @property {(numbers: number[]) => void} setView
 * @property {() => void} draw
 */
