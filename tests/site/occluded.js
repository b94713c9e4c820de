/**
 * Reads questions as JSON from standard input and answers them with the site's own modules:
 * `tests/test_site_streams.py` compares the answers with Python's.
 */
import {readFileSync} from 'node:fs';

import {cameraPose} from '../../madviz/site/web/cameras.js';
import {occluded} from '../../madviz/site/web/streams.js';
import {conditionOf, readSubsets} from '../../madviz/site/web/subsets.js';

const answers = {
  occluded: ({rgba, side, occlusion, before}) =>
    [...occluded(Uint8ClampedArray.from(rgba), side, occlusion,
      before && Uint8ClampedArray.from(before), () => 0)],
  condition: ({streams, cameras, moves}) => conditionOf(streams, cameras, moves),
  subsets: ({streams, trained}) => readSubsets(streams, trained),
  pose: ({camera, move}) => cameraPose(camera, move ?? undefined, {body: () => [0.1, 0.2, 0.3]}),
};

const asked = JSON.parse(readFileSync(0, 'utf8'));
console.log(JSON.stringify(asked.map(({what, ...rest}) => answers[what](rest))));
