"""Which bodies of a MuJoCo model are the robot, and which is the object that is moved: by rules, without a list.

The robot is what is driven: the kinematic trees that hold joints with an actuator, or a body that is welded to a mocap
body. The object is the body of the undriven joint that moves most over the recorded states. Movement is no ground truth
of a task: it is the same whether the door was to be opened or closed, and no reward or success is looked at.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence

import zest_rl.runtime.load_order  # noqa: F401  # isort: skip
import mujoco
import numpy as np
from numpy.typing import NDArray

from zest_rl.errors import BadInput, Notice, nearest

Bodies = NDArray[np.bool_]
"""(nbody,) whether each body of a model belongs to a set."""
_STILL, _ALIKE = 1e-3, 0.9
"""Metres of movement that count as none; and the share of the largest movement from which another is as large."""
_BY_CAMERA = "use a camera of the model (--camera NAME, or default)"
_INSTEAD = f"name what to look at with --look-at BODY, or {_BY_CAMERA}"


def body_name(model: mujoco.MjModel, body: int) -> str:
    """Return the name of a body, or a description where it has none."""
    return str(model.body(body).name) or f"(body {body})"


def subtree(model: mujoco.MjModel, roots: Sequence[int]) -> Bodies:
    """Return some bodies with everything below them."""
    inside = np.zeros(model.nbody, bool)
    inside[list(roots)] = True
    for body in range(1, model.nbody):  # parents come first
        inside[body] |= inside[model.body_parentid[body]]
    return inside


def bodies_named(model: mujoco.MjModel, names: Sequence[str], flag: str) -> list[int]:
    """Return the bodies of these names; `flag` is where the user gave them.

    Raises:
        BadInput: the model has no such body.
    """
    known = {str(model.body(body).name): body for body in range(1, model.nbody)}
    for name in names:
        if name not in known:
            raise BadInput(f"{flag}: the model has no body {name!r}; {nearest(name, filter(None, known))}")
    return [known[name] for name in names]


def robot_bodies(model: mujoco.MjModel) -> Bodies:
    """Return the robot: all kinematic trees with a driven joint, their static mounts, and the mocap bodies.

    A mount is what is above a tree, as far as nothing else that moves hangs on it. Empty if nothing is driven.
    """
    driven = _driven(model)
    trees = {int(model.body_treeid[body]) for body in driven} - {-1}
    foreign = (model.body_treeid >= 0) & ~np.isin(model.body_treeid, list(trees))
    roots = []
    for body in (*driven, *(np.flatnonzero(model.body_mocapid >= 0) if driven else ())):
        while (parent := model.body_parentid[body]) and not (subtree(model, [parent]) & foreign).any():
            body = parent
        roots.append(body)
    return subtree(model, roots)


def _driven(model: mujoco.MjModel) -> set[int]:
    """Return the bodies that an actuator or a weld to a mocap body acts on."""
    transmission, body = mujoco.mjtTrn, set[int]()
    for kind, (target, _) in zip(model.actuator_trntype, model.actuator_trnid, strict=True):
        if kind in (transmission.mjTRN_JOINT, transmission.mjTRN_JOINTINPARENT):
            body.add(int(model.jnt_bodyid[target]))
        elif kind == transmission.mjTRN_TENDON:
            wraps = slice(model.tendon_adr[target], model.tendon_adr[target] + model.tendon_num[target])
            for wrap, wrapped in zip(model.wrap_type[wraps], model.wrap_objid[wraps], strict=True):
                if wrap in (mujoco.mjtWrap.mjWRAP_JOINT, mujoco.mjtWrap.mjWRAP_SITE):
                    of = model.jnt_bodyid if wrap == mujoco.mjtWrap.mjWRAP_JOINT else model.site_bodyid
                    body.add(int(of[wrapped]))
        else:
            body.add(int(target if kind == transmission.mjTRN_BODY else model.site_bodyid[target]))
    for kind, obj, one, other in zip(model.eq_type, model.eq_objtype, model.eq_obj1id, model.eq_obj2id, strict=True):
        if kind in (mujoco.mjtEq.mjEQ_WELD, mujoco.mjtEq.mjEQ_CONNECT):
            pair = [int(i if obj == mujoco.mjtObj.mjOBJ_BODY else model.site_bodyid[i]) for i in (one, other)]
            if (model.body_mocapid[pair] >= 0).any():
                body.update(pair)
    return body - {0}


def joint_travel(model: mujoco.MjModel, data: mujoco.MjData, qpos: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return how far the joints move what hangs on them.

    Args:
        model: of the states.
        data: kinematics of the first state.
        qpos: (N, nq) states of one episode.

    Returns:
        (njnt,) metres: the farthest from the first state. An angle counts by the reach of the moved parts.
    """
    travel = np.zeros(model.njnt)
    for joint in range(model.njnt):
        adr, kind = model.jnt_qposadr[joint], model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            far = np.linalg.norm(qpos[:, adr : adr + 3] - qpos[0, adr : adr + 3], axis=1)
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            cosine = np.abs(qpos[:, adr : adr + 4] @ qpos[0, adr : adr + 4]).clip(0, 1)
            far = 2 * np.arccos(cosine) * _reach(model, data, joint)
        else:
            lever = 1.0 if kind == mujoco.mjtJoint.mjJNT_SLIDE else _reach(model, data, joint)
            far = np.abs(qpos[:, adr] - qpos[0, adr]) * lever
        travel[joint] = far.max()
    return travel


def _reach(model: mujoco.MjModel, data: mujoco.MjData, joint: int) -> float:
    """Return the largest distance of what hangs on a joint from its axis (of a ball: from its centre), in metres."""
    geoms = np.flatnonzero(subtree(model, [model.jnt_bodyid[joint]])[model.geom_bodyid])
    arms = data.geom_xpos[geoms] - data.xanchor[joint]
    if model.jnt_type[joint] == mujoco.mjtJoint.mjJNT_HINGE:
        arms = np.cross(arms, data.xaxis[joint])
    return float(max((np.linalg.norm(arms, axis=1) + model.geom_rbound[geoms]).tolist(), default=0.0))


def moved_body(model: mujoco.MjModel, travel: NDArray[np.float64], robot: Bodies) -> int:
    """Return the body that moves most among those outside the robot.

    Args:
        model: of the states.
        travel: (njnt,) metres that each joint moves on average, see `joint_travel`.
        robot: what is no object; a `Notice` tells if the only object never moves.

    Raises:
        BadInput: nothing outside the robot has a joint, none of it moves, or two move alike.
    """
    joints = np.flatnonzero(~robot[model.jnt_bodyid])
    if len(joints) == 0:
        raise BadInput(
            "the object is the body of an unactuated joint, but all joints of the model belong to the robot; keep the "
            f"robot in view (--show-robot --look-at BODY), or {_BY_CAMERA}"
        )
    by_body = dict[int, float]()
    for joint in joints:
        body = int(model.jnt_bodyid[joint])
        by_body[body] = max(by_body.get(body, 0.0), float(travel[joint]))
    names = ", ".join(f"{body_name(model, body)} {far:.3f} m" for body, far in by_body.items())
    best = max(by_body, key=lambda body: by_body[body])
    if len(by_body) == 1 and by_body[best] < _STILL:
        warnings.warn(
            f"{body_name(model, best)} is looked at, the only object, but no recorded episode moves it by {_STILL:g} "
            f"m, so frames show no change; {_INSTEAD}",
            Notice,
            stacklevel=2,
        )
    elif by_body[best] < _STILL:
        raise BadInput(
            f"the object is what moves most in the recorded episodes, but nothing moves by {_STILL:g} m ({names}); "
            + _INSTEAD
        )
    tied = _coupled(model, model.body_treeid[best])
    rivals = [b for b, far in by_body.items() if far >= _ALIKE * by_body[best] and model.body_treeid[b] not in tied]
    if rivals:
        raise BadInput(
            f"the object is what moves most in the recorded episodes, but {body_name(model, best)} and "
            f"{body_name(model, rivals[0])} move alike ({names}); {_INSTEAD}"
        )
    return best


def _coupled(model: mujoco.MjModel, tree: int) -> set[int]:
    """Return a kinematic tree and those whose joints the model couples to it."""
    trees = {int(tree)}
    for equality in np.flatnonzero(model.eq_type == mujoco.mjtEq.mjEQ_JOINT):
        pair = [model.eq_obj1id[equality], model.eq_obj2id[equality]]
        of = {int(model.body_treeid[model.jnt_bodyid[joint]]) for joint in pair if joint >= 0}
        trees |= of if int(tree) in of else set()
    return trees
