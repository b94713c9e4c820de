# %% [markdown]
# # Solution 6: black for merges that cannot drop a camera

# %%
import numpy as np

from madviz import teaching
from madviz.teaching.lessons import untrained
from madviz.teaching.show import table

teaching.begin()
mad, concat = untrained("mad"), untrained("concat")
moment = teaching.moment_at(mad, step=3)
black = moment.stack.copy()
black[1] = 0
everything, without = np.array([[True] * 3]), np.array([[True, False, True]])


def action(policy, stack, mask):
    return policy.read(policy.encode(stack, moment.state), mask).action[0]


rows = [
    [name, float(np.linalg.norm(changed - action(policy, moment.stack, everything)))]
    for name, policy, changed in (
        ("concat, Third A black", concat, action(concat, black, everything)),
        ("mad, Third A black", mad, action(mad, black, everything)),
        ("mad, Third A dropped", mad, action(mad, moment.stack, without)),
    )
]
table(["what happened", "distance of the action"], rows)

# %% [markdown]
# The numbers of untrained networks mean nothing by themselves. The point is the third row: it
# exists for MAD alone. A sum without a term is still a sum; features side by side with one of them
# missing are not what the network expects.
