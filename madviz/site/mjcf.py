"""A MuJoCo model as text again, without a loss: what the browser's MuJoCo compiles.

The problem: MuJoCo's own ``mj_saveLastXML`` writes about six digits, and its binary form belongs to
one version. The browser runs a later version, and an episode with contacts grows any difference.

The idea: a compiled model has few kinds of things, so they are written one by one, with 17 digits,
which give the same double back. Only what moves or touches something is written: shapes that
collide (24 of hammer's 56), with the convex hull of a mesh in place of the mesh; inertia is given,
so nothing is missed that has mass. Bodies keep their numbers, since drawing refers to them.

    hammer: 57 kB of text, 18 kB gzipped; compiled by MuJoCo 3.3.0 it gives the same arrays
"""

from __future__ import annotations

from typing import Any
from xml.sax.saxutils import quoteattr

import mujoco
import numpy as np

from madviz.errors import UserError
from madviz.types import Array

_JOINTS = {0: "free", 1: "ball", 2: "slide", 3: "hinge"}
_GEOMS = {0: "plane", 2: "sphere", 3: "capsule", 4: "ellipsoid", 5: "cylinder", 6: "box", 7: "mesh"}
_BIASES = {0: "none", 1: "affine"}
_CONES = {0: "pyramidal", 1: "elliptic"}
_JACOBIANS = {0: "dense", 1: "sparse", 2: "auto"}
_SOLVERS = {0: "PGS", 1: "CG", 2: "Newton"}
_OPTION_NUMBERS = (
    "timestep", "impratio", "gravity", "wind", "density", "viscosity", "iterations", "tolerance",
    "ls_iterations", "ls_tolerance", "ccd_iterations", "ccd_tolerance", "noslip_iterations",
)  # fmt: skip

_GEOM_NUMBERS = (
    "contype", "conaffinity", "condim", "priority", "friction", "solmix", "solref", "solimp",
    "margin", "gap", "pos", "quat",
)  # fmt: skip


def model_text(model: mujoco.MjModel) -> str:
    """The model as MJCF. Raises UserError for a model with parts that this does not write."""
    _check_known(model)
    lines = ["<mujoco>", '<compiler angle="radian" autolimits="false" inertiafromgeom="false"/>']
    lines += [_option(model), "<asset>", *_hulls(model), "</asset>", "<worldbody>"]
    lines += [*_inside(model, 0), "</worldbody>"]
    lines += ["<equality>", *_welds(model), "</equality>"]
    lines += ["<actuator>", *_actuators(model), "</actuator>", "</mujoco>"]
    return "\n".join(lines) + "\n"


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Some bodies have no name, and references need one."""
    return model.body(body).name or f"body-{body}"


def _check_known(model: mujoco.MjModel) -> None:
    unknown = {
        "tendons": model.ntendon,
        "sensors": model.nsensor,
        "contact pairs": model.npair,
        "contact exclusions": model.nexclude,
        "flexes": model.nflex,
        "plugins": model.nplugin,
        "activations": model.na,
        "flags": model.opt.disableflags | model.opt.enableflags,
        "an integrator other than Euler's": int(model.opt.integrator),
        "gaps between shapes": np.count_nonzero(model.geom_gap),
        "compensated gravity": np.count_nonzero(model.body_gravcomp),
        "constraints other than welds": np.count_nonzero(
            model.eq_type != mujoco.mjtEq.mjEQ_WELD.value
        ),
    }
    parts = [name for name, count in unknown.items() if count]
    if parts:
        raise UserError(f"expected a model that a site can hold, found one with {', '.join(parts)}")


def _element(tag: str, /, closed: bool = True, **attributes: Any) -> str:
    """``<name key="value"/>``; numbers with 17 digits, None is left out."""
    parts = [tag]
    for key, value in attributes.items():
        if value is None:
            continue
        if isinstance(value, bool | np.bool_):
            value = "true" if value else "false"
        text = value if isinstance(value, str) else _numbers(value)
        parts.append(f"{key}={quoteattr(text)}")
    return f"<{' '.join(parts)}{'/' if closed else ''}>"


def _numbers(value: Any) -> str:
    """Nine digits give the same float32 back, and 17 the same double."""
    digits = 9 if getattr(value, "dtype", None) == np.float32 else 17
    return " ".join(f"{number:.{digits}g}" for number in np.ravel(np.asarray(value, float)))


def _fields(model: mujoco.MjModel, kind: str, number: int, *names: str) -> dict[str, Any]:
    """Attributes that MJCF and the model name alike: those of thing ``number`` of its ``kind``."""
    return {name: getattr(model, f"{kind}_{name}")[number] for name in names}


def _option(model: mujoco.MjModel) -> str:
    option = model.opt
    return _element(
        "option",
        **{name: getattr(option, name) for name in _OPTION_NUMBERS},
        integrator="Euler",
        cone=_CONES[int(option.cone)],
        jacobian=_JACOBIANS[int(option.jacobian)],
        solver=_SOLVERS[int(option.solver)],
    )


def _collides(model: mujoco.MjModel, geom: int) -> bool:
    return bool(model.geom_contype[geom] or model.geom_conaffinity[geom])


def _hulls(model: mujoco.MjModel) -> list[str]:
    """The convex hull of every mesh that collides: MuJoCo collides with nothing else of it."""
    geoms = [g for g in range(model.ngeom) if _collides(model, g)]
    meshes = sorted({int(model.geom_dataid[g]) for g in geoms if model.geom_dataid[g] >= 0})
    lines = []
    for mesh in meshes:
        vertices, faces = _hull(model, mesh)
        text = " ".join(str(index) for index in faces.ravel())
        lines.append(_element("mesh", name=f"mesh-{mesh}", vertex=vertices, face=text))
    return lines


def _hull(model: mujoco.MjModel, mesh: int) -> tuple[Array, Array]:
    """(n, 3) vertices and (m, 3) faces of the hull of ``mesh``, as its convex graph has them."""
    start = int(model.mesh_graphadr[mesh])
    if start < 0:
        raise UserError(f"expected a mesh with a convex hull, found {model.mesh(mesh).name!r}")
    count = int(model.mesh_graph[start])
    triangles = int(model.mesh_graph[start + 1])
    chosen = model.mesh_graph[start + 2 + count : start + 2 + 2 * count]
    first = start + 2 + 3 * count + 3 * triangles
    faces = model.mesh_graph[first : first + 3 * triangles].reshape(-1, 3)
    place = {int(vertex): i for i, vertex in enumerate(chosen)}
    vertices = model.mesh_vert[model.mesh_vertadr[mesh] + chosen]
    return vertices, np.vectorize(place.__getitem__)(faces)


def _inside(model: mujoco.MjModel, body: int) -> list[str]:
    """The elements of ``body``, and the bodies in it, in the order of their numbers."""
    lines = [_joint(model, j) for j in range(model.njnt) if model.jnt_bodyid[j] == body]
    for geom in np.flatnonzero(model.geom_bodyid == body).tolist():
        if _collides(model, geom):
            lines.append(_geom(model, geom))
    for site in np.flatnonzero(model.site_bodyid == body).tolist():
        place = _fields(model, "site", site, "pos", "quat")
        lines.append(_element("site", name=model.site(site).name or f"site-{site}", **place))
    for inner in range(1, model.nbody):
        if model.body_parentid[inner] == body:
            lines += _body(model, inner)
    return lines


def _body(model: mujoco.MjModel, body: int) -> list[str]:
    mocap = True if model.body_mocapid[body] >= 0 else None
    place = _fields(model, "body", body, "pos", "quat")
    lines = [_element("body", closed=False, name=body_name(model, body), **place, mocap=mocap)]
    if model.body_mass[body] > 0:
        place = {"pos": model.body_ipos[body], "quat": model.body_iquat[body]}
        inertia = model.body_inertia[body]
        mass = model.body_mass[body]
        lines.append(_element("inertial", **place, mass=mass, diaginertia=inertia))
    return [*lines, *_inside(model, body), "</body>"]


def _joint(model: mujoco.MjModel, joint: int) -> str:
    dof = int(model.jnt_dofadr[joint])
    kind = _JOINTS[int(model.jnt_type[joint])]
    own = {}
    if kind in ("slide", "hinge"):
        at = int(model.jnt_qposadr[joint])
        own = {
            "axis": model.jnt_axis[joint],
            "ref": model.qpos0[at],
            "springref": model.qpos_spring[at],
        }
    return _element(
        "joint",
        name=model.joint(joint).name or f"joint-{joint}",
        type=kind,
        pos=None if kind == "free" else model.jnt_pos[joint],
        limited=bool(model.jnt_limited[joint]),
        **_fields(model, "jnt", joint, "range", "margin", "stiffness"),
        **_fields(model, "dof", dof, "damping", "armature", "frictionloss"),
        solreflimit=model.jnt_solref[joint],
        solimplimit=model.jnt_solimp[joint],
        solreffriction=model.dof_solref[dof],
        solimpfriction=model.dof_solimp[dof],
        **own,
    )


def _geom(model: mujoco.MjModel, geom: int) -> str:
    kind = _GEOMS[int(model.geom_type[geom])]
    mesh = f"mesh-{int(model.geom_dataid[geom])}" if kind == "mesh" else None
    size = None if mesh else model.geom_size[geom]
    name = model.geom(geom).name or f"geom-{geom}"
    numbers = _fields(model, "geom", geom, *_GEOM_NUMBERS)
    return _element("geom", name=name, type=kind, mesh=mesh, size=size, **numbers)


def _welds(model: mujoco.MjModel) -> list[str]:
    return [
        _element(
            "weld",
            body1=body_name(model, int(model.eq_obj1id[weld])),
            body2=body_name(model, int(model.eq_obj2id[weld])),
            active=bool(model.eq_active0[weld]),
            anchor=model.eq_data[weld, :3],
            relpose=model.eq_data[weld, 3:10],
            torquescale=model.eq_data[weld, 10],
            **_fields(model, "eq", weld, "solref", "solimp"),
        )
        for weld in range(model.neq)
    ]


def _actuators(model: mujoco.MjModel) -> list[str]:
    return [
        _element(
            "general",
            name=model.actuator(a).name or f"actuator-{a}",
            joint=model.joint(int(model.actuator_trnid[a, 0])).name,
            ctrllimited=bool(model.actuator_ctrllimited[a]),
            ctrlrange=model.actuator_ctrlrange[a],
            forcelimited=bool(model.actuator_forcelimited[a]),
            **_fields(model, "actuator", a, "forcerange", "gear", "gainprm"),
            biastype=_BIASES[int(model.actuator_biastype[a])],
            biasprm=model.actuator_biasprm[a],
        )
        for a in range(model.nu)
    ]
