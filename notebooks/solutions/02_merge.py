# %% [markdown]
# # Solution 2: a mean in place of a sum

# %%
import numpy as np

import madviz
from madviz import teaching
from madviz.subsets import every_mask, name_of
from madviz.teaching.show import table

teaching.begin()
policy = madviz.load_policy("metaworld-hammer-mad-light")
now = teaching.moment_at(policy, seed=2000, step=20)
masks = every_mask(3)[:-1]
sums = masks.astype(np.float32) @ now.probe.features
means = sums / masks.sum(1, keepdims=True)
rows = [
    [name_of(mask, policy.spec.streams), *(float(np.linalg.norm(x)) for x in (total, mean))]
    for mask, total, mean in zip(masks, sums, means, strict=True)
]
table(["cameras", "norm of the sum", "norm of the mean"], rows)

# %% [markdown]
# A mean does not make the norms alike: it reverses their order. Three features that point in
# different directions shrink when they are averaged, so now the single cameras have large norms
# and all together a small one. The norm still depends on the number of cameras. And something is
# lost: with a sum, a camera adds the same term in every subset; with a mean, it counts for a
# third as soon as two others join. The paper's sum keeps a single camera's feature exactly what
# that camera's own policy would get.
