# %% [markdown]
# # Solution 5: colour black, depth intact

# %%
import numpy as np

import madviz
from madviz import teaching
from madviz.teaching.show import table

teaching.begin()
policy = madviz.load_policy("metaworld-hammer-mad-three-rgbd-light")
now = teaching.moment_at(policy, seed=2000, step=20)
stack = now.stack.copy()
stack[[name.endswith(".rgb") for name in policy.spec.streams]] = 0
everything = np.ones((1, len(stack)), bool)
dark = policy.read(policy.encode(stack, now.state), everything).action[0]
rows = [[name, float(np.linalg.norm(dark - now.action(name)))] for name in ("all", "depth", "rgb")]
table(["distance of the action in the dark to that of", "distance"], rows)

# %% [markdown]
# Black colour is not absent colour: three features of black pictures are in the sum. If it is
# known that the light is out, it is better to drop the colour streams: the policy was trained on
# `depth`.
