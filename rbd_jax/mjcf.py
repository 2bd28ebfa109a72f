"""Layer 4: MJCF in and out. Host only; with ``parity.py`` the only module that knows MuJoCo's conventions.

``load_mjcf`` lets MuJoCo compile the file and reads the compiled model, so defaults, includes, replicate, frames,
alignment and inferred inertias are MuJoCo's own. ``to_mjcf`` writes a file that MuJoCo simulates as it is.
What MJCF has no field for is written under ``<custom>``, in elements named

    rbd_restitution:GEOM   restitution [-]
    rbd_friction:GEOM      a friction coefficient [-] that is a value although 0 or on a geom of condim 1
    rbd_torsional_friction:GEOM, rbd_rolling_friction:GEOM   the same [m], of condim below 4 or 6
    rbd_vel:BODY           velocity [m/s]: of a mocap body's origin; of a free body's centre of mass
    rbd_omega:BODY         angular velocity, world [rad/s]
    rbd_drag               drag rate, or (linear, angular) [1/s]
    rbd_gravity            gravity [m/s^2] that is a value although 0
    rbd_mass:BODY, rbd_density:BODY, rbd_com:BODY, rbd_inertia:BODY   digits of mass properties as they were given
    rbd_given:BODY         (text) which of mass, density, com, inertia the scene gave
    rbd_unnamed            (text, JSON) geoms whose name is automatic
    rbd_pairs              (text, JSON) overrides and exclusions as the scene wrote them
    rbd_jax                (text) format of these elements; only in exported files

GEOM is a geom's name or its automatic one. The first seven may be written by hand. Where MuJoCo has a field of its
own, that field wins: a custom digit string is used only if it agrees with the compiled model.
"""

from __future__ import annotations

import dataclasses
import json
import os
import warnings
import xml.etree.ElementTree as ET

import mujoco
import numpy as np

from .scene import (
    CONDIMS,
    DYNAMIC,
    KINEMATIC,
    STATIC,
    Body,
    Geom,
    Pair,
    ResolvedScene,
    Scene,
    mass_properties,
    resolve,
    rotation,
)
from .shapes import Box, Plane, Shape, Sphere

KEEP = ("friction", "omega", "vel", "gravity")
FORMAT = "1"
START_KEY = "start"
#: Where MuJoCo keeps each coefficient: in a geom's three numbers, in a pair's five.
GEOM_FRICTION = dict(zip(CONDIMS, (0, 1, 2)))
PAIR_FRICTION = dict(zip(CONDIMS, (0, 2, 3)))
AGREE = 1e-10  # [-] relative; a custom value this near to the compiled one is the same number with more digits
ROUNDING = 1e-15  # entries of a rotation this near to -1, 0, 1 come from a quarter turn

_G = mujoco.mjtGeom
_SHAPES = {
    int(_G.mjGEOM_PLANE): lambda size: Plane(),
    int(_G.mjGEOM_SPHERE): lambda size: Sphere(float(size[0])),
    int(_G.mjGEOM_BOX): lambda size: Box(tuple(map(float, size))),
}
_GEOM_TYPES = {int(v): k[len("mjGEOM_") :].lower() for k, v in _G.__members__.items()}
_INTEGRATORS = {"Euler": "euler", "implicitfast": "implicitfast", "RK4": "rk4"}
_SOLVERS = {"PGS": "pgs", "CG": "cg", "Newton": "newton"}


def _enum_names(enum, prefix):
    return {int(v): k[len(prefix) :] for k, v in enum.__members__.items()}


_COMPILED_INTEGRATORS = _enum_names(mujoco.mjtIntegrator, "mjINT_")
_COMPILED_SOLVERS = _enum_names(mujoco.mjtSolver, "mjSOL_")
_DISABLE, _ENABLE = mujoco.mjtDisableBit, mujoco.mjtEnableBit


# ---------------------------------------------------------------------------------------------------------
# In
# ---------------------------------------------------------------------------------------------------------


def load_mjcf(source, restitution=None, keep=(), keyframe=None) -> Scene:
    """Read a scene from MJCF.

    Supported: free bodies that are children of the world, mocap bodies (kinematic), geoms of the world and of bodies
    fixed to it (static), of types sphere, box and plane. Cameras, lights, materials, sites, sensors, and geoms of
    other types that neither collide nor are in a contact pair are ignored. A pyramidal friction cone is taken as
    elliptic, with a warning where there is friction.

    Exact zeros count as absent: friction, gravity, start velocities. A zero angular velocity counts as absent only
    where nothing has friction. Values under ``<custom>`` (module docstring) are values even when 0.

    Args:
      source: path of a file (includes are relative to it), or XML text, which starts with ``<``.
      restitution: coefficient [-] for every geom, whatever ``<custom>`` says; ``None`` leaves them as they are.
      keep: which zeros are values: any of ``"friction"``, ``"omega"``, ``"vel"``, ``"gravity"``.
      keyframe: start state, by name or index; ``None`` is the first if there is one; ``False`` is none (qpos0).

    Returns:
      The scene. Body frames are MuJoCo's; ``vel`` and ``omega`` are converted from qvel (velocity of the frame's
      origin in the world, angular velocity in the body frame) to ours (centre of mass, world).

    Raises:
      FileNotFoundError: no such file.
      ValueError: MuJoCo does not compile it, or it holds what is not supported (all reasons at once).
    """
    keep = _check_keep(keep)
    model, label = _compile(source)
    reader = _Reader(model, keep, restitution, keyframe)
    if reader.reasons:
        raise ValueError(
            f"{label}: rbd_jax simulates free bodies with sphere, box and plane geoms; not supported:\n  - "
            + "\n  - ".join(reader.reasons)
        )
    scene = reader.scene()
    if model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL and resolve(scene).pair_friction()[1].any():
        warnings.warn(f"{label}: the pyramidal friction cone is treated as elliptic", UserWarning, stacklevel=2)
    return scene


def _check_keep(keep):
    keep = (keep,) if isinstance(keep, str) else tuple(keep)
    for name in keep:
        if name not in KEEP:
            raise ValueError(f"keep = {name!r} must be one of {', '.join(map(repr, KEEP))}")
    return keep


def _compile(source):
    """Return the compiled model and how to call it in messages."""
    if isinstance(source, bytes):
        source = source.decode()
    text = source.lstrip("\ufeff \t\r\n") if isinstance(source, str) else ""
    if text.startswith("<"):
        label, root = "MJCF text", text
    else:
        label = os.fspath(source)
        if not os.path.exists(label):
            raise FileNotFoundError(f"{label}: no such MJCF file")
        if os.path.isdir(label):
            raise IsADirectoryError(f"{label}: is a directory, not an MJCF file")
        with open(label, encoding="utf-8", errors="replace") as file:
            root = file.read()
    if "<robot" in root and "<mujoco" not in root.split("<robot")[0]:
        raise ValueError(f"{label}: URDF is not supported; convert it to MJCF with MuJoCo first")
    try:
        if text.startswith("<"):
            return mujoco.MjModel.from_xml_string(text), label
        return mujoco.MjModel.from_xml_path(label), label
    except ValueError as error:
        raise ValueError(f"{label}: MuJoCo cannot compile it: {error}") from None


class _Reader:
    """Reads one compiled model. ``reasons`` lists what is not supported; ``scene()`` is valid if it is empty."""

    def __init__(self, model, keep, restitution, keyframe):
        self.m, self.keep, self.restitution = model, keep, restitution
        self.key = self._find_key(keyframe)
        self.body_names = self._name_bodies()
        weld = model.body_weldid
        joints = [range(a, a + n) for a, n in zip(model.body_jntadr, model.body_jntnum)]
        ids = range(1, model.nbody)
        self.free = [b for b in ids if any(model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE for j in joints[b])]
        self.mocap = [b for b in ids if model.body_mocapid[b] >= 0]
        self.fixed = [b for b in range(model.nbody) if weld[b] == 0]
        in_pair = {int(g) for p in (model.pair_geom1, model.pair_geom2) for g in p}
        self.collides = [
            bool(model.geom_contype[g] or model.geom_conaffinity[g]) or g in in_pair for g in range(model.ngeom)
        ]
        known = [int(t) in _SHAPES for t in model.geom_type]
        self.geoms = {b: [] for b in range(model.nbody)}
        for g in range(model.ngeom):
            if known[g] or self.collides[g]:
                self.geoms[int(model.geom_bodyid[g])].append(g)
        self.order = [g for bodies in (self.free, self.mocap, self.fixed) for b in bodies for g in self.geoms[b]]
        self.labels = self._label_geoms()
        self.numeric, self.text = self._read_custom()
        self.reasons = self._refusals() + self._custom_errors()

    # names

    def _name(self, kind, i):
        return mujoco.mj_id2name(self.m, kind, i) or None

    def _name_bodies(self):
        names = [self._name(mujoco.mjtObj.mjOBJ_BODY, b) for b in range(self.m.nbody)]
        taken = set(names)
        for b, name in enumerate(names):
            if name is None:
                name = f"body{b}"
                while name in taken:
                    name += "'"
                taken.add(name)
                names[b] = name
        return names

    def _label_geoms(self):
        """Name of each geom, given or automatic, by the rule of ``scene``."""
        wanted, statics = {}, 0
        for b in self.free + self.mocap:
            for j, g in enumerate(self.geoms[b]):
                wanted[g] = self.body_names[b] if len(self.geoms[b]) == 1 else f"{self.body_names[b]}:{j}"
        for b in self.fixed:
            for g in self.geoms[b]:
                wanted[g] = f"static:{statics}"
                statics += 1
        given = {g: self._name(mujoco.mjtObj.mjOBJ_GEOM, g) for g in self.order}
        taken, labels = set(given.values()), {}
        for g in self.order:
            label = wanted[g]
            while given[g] is None and label in taken:
                label += "'"
            taken.add(label if given[g] is None else given[g])
            labels[g] = given[g] or label
        return labels

    # custom elements

    def _read_custom(self):
        m, numeric, text = self.m, {}, {}
        for i in range(m.nnumeric):
            name = self._name(mujoco.mjtObj.mjOBJ_NUMERIC, i)
            if name and name.startswith("rbd_"):
                start = m.numeric_adr[i]
                numeric[name] = tuple(map(float, m.numeric_data[start : start + m.numeric_size[i]]))
        for i in range(m.ntext):
            name = self._name(mujoco.mjtObj.mjOBJ_TEXT, i)
            if name and name.startswith("rbd_"):
                start = m.text_adr[i]
                text[name] = bytes(m.text_data[start : start + m.text_size[i]]).rstrip(b"\0").decode()
        return numeric, text

    def _custom_errors(self):
        bodies = {self.body_names[b] for b in self.free + self.mocap}
        geoms = set(self.labels.values())
        rules = {  # kind -> (allowed counts, whose name follows)
            "rbd_restitution": ((1,), geoms), **{f"rbd_{f}": ((1,), geoms) for f in CONDIMS}, "rbd_vel": ((3,), bodies),
            "rbd_omega": ((3,), bodies), "rbd_mass": ((1,), bodies), "rbd_density": ((1,), bodies),
            "rbd_com": ((3,), bodies), "rbd_inertia": ((3, 9), bodies), "rbd_drag": ((1, 2), None),
            "rbd_gravity": ((3,), None),
        }  # fmt: skip
        errors = []
        for name, value in self.numeric.items():
            kind, colon, owner = name.partition(":")
            counts, owners = rules.get(kind, ((), None))
            if not counts or (owners is None) == bool(colon):
                errors.append(f"custom numeric '{name}': unknown name")
            elif len(value) not in counts:
                errors.append(f"custom numeric '{name}': data = {value} must have {counts[0]} entries")
            elif owners is not None and owner not in owners:
                errors.append(f"custom numeric '{name}': no {'geom' if owners is geoms else 'body'} named '{owner}'")
        for name, value in self.text.items():
            kind, _, owner = name.partition(":")
            if kind not in ("rbd_given", "rbd_unnamed", "rbd_pairs", "rbd_jax"):
                errors.append(f"custom text '{name}': unknown name")
            elif kind == "rbd_given" and owner not in bodies:
                errors.append(f"custom text '{name}': no body named '{owner}'")
            elif name == "rbd_jax" and value != FORMAT:
                errors.append(f"custom text 'rbd_jax': format {value!r}; this version reads {FORMAT!r}")
        return errors

    # what is refused

    def _refusals(self):
        out = []
        self._refuse_bodies(out)
        self._refuse_geoms(out)
        self._refuse_elements(out)
        self._refuse_pairs(out)
        self._refuse_options(out)
        if not self.free:
            out.append("no free body: nothing moves (rbd_jax needs at least one body with a free joint)")
        return out

    def _label(self, element, kind, i, body=None):
        name = self._name(kind, i)
        where = "" if body is None else f" (body '{self.body_names[body]}')"
        return f"{element} '{name}'{where}" if name else f"{element} {i}{where}"

    def _refuse_bodies(self, out):
        m = self.m
        single = _enum_names(mujoco.mjtJoint, "mjJNT_")
        for j in range(m.njnt):
            who = self._label("joint", mujoco.mjtObj.mjOBJ_JOINT, j, int(m.jnt_bodyid[j]))
            kind = single[int(m.jnt_type[j])].lower()
            if kind != "free":
                out.append(f"{who}: {kind} joint; only free joints are simulated")
                continue
            d = m.jnt_dofadr[j]
            for field, value in (
                ("stiffness", _worst(m.jnt_stiffness[j], m.jnt_stiffnesspoly[j])),
                ("damping", _worst(m.dof_damping[d : d + 6], m.dof_dampingpoly[d : d + 6])),
                ("armature", _worst(m.dof_armature[d : d + 6])),
                ("frictionloss", _worst(m.dof_frictionloss[d : d + 6])),
            ):
                if value:
                    out.append(f"{who}: {field} = {value:g} on a free joint; must be 0")
        for b in range(1, m.nbody):
            who = f"body '{self.body_names[b]}'"
            if m.body_parentid[b] != 0 and m.body_weldid[b] != 0:
                parent = self.body_names[m.body_parentid[b]]
                out.append(
                    f"{who}: nested in body '{parent}'; bodies must be children of the world "
                    '(<compiler fusestatic="true"/> merges jointless ones)'
                )
            if m.body_gravcomp[b] and m.body_weldid[b] != 0:
                out.append(f"{who}: gravcomp = {m.body_gravcomp[b]:g} (gravity compensation); must be 0")
            if m.body_plugin[b] >= 0:
                out.append(f"{who}: plugin")

    def _refuse_geoms(self, out):
        m = self.m
        active = [g for g in range(m.ngeom) if self.collides[g]]
        for g in active:
            who = self._label("geom", mujoco.mjtObj.mjOBJ_GEOM, g, int(m.geom_bodyid[g]))
            kind = int(m.geom_type[g])
            if kind not in _SHAPES:
                out.append(f"{who}: {_GEOM_TYPES.get(kind, kind)} geom; only sphere, box and plane are simulated")
            if m.geom_margin[g] < 0:
                out.append(f"{who}: margin = {m.geom_margin[g]:g} [m] (shrinks the geom); must be >= 0")
            for field, value, what in (
                ("gap", m.geom_gap[g], "inactive contacts"),
                ("adhesion", m.geom_adhesion[g], "adhesive contacts"),
                ("surfacevel", _worst(m.geom_surfacevel[g]), "moving surface; use a mocap body with rbd_vel:BODY"),
            ):
                if value:
                    out.append(f"{who}: {field} = {value:g} ({what}); must be 0")
        mixed = {(*m.geom_solref[g], *m.geom_solimp[g]) for g in active}
        if len({float(m.geom_solmix[g]) for g in active}) > 1 and len(mixed) > 1:
            out.append("geom solmix: geoms differ in it; solref and solimp are averaged evenly (use contact/pair)")

    def _refuse_elements(self, out):
        m, obj = self.m, mujoco.mjtObj
        for element, kind, count in (
            ("tendon", obj.mjOBJ_TENDON, m.ntendon),
            ("actuator", obj.mjOBJ_ACTUATOR, m.nactuator),
            ("equality constraint", obj.mjOBJ_EQUALITY, m.neq),
            ("flex", obj.mjOBJ_FLEX, m.nflex),
        ):
            out.extend(f"{self._label(element, kind, i)}: not simulated" for i in range(count))

    def _refuse_pairs(self, out):
        m = self.m
        for p in range(m.npair):
            who = self._label("pair", mujoco.mjtObj.mjOBJ_PAIR, p)
            friction = m.pair_friction[p]
            for least, one, two, which in ((3, 0, 1, "first"), (6, 3, 4, "last")):
                if m.pair_dim[p] >= least and friction[one] != friction[two]:
                    out.append(
                        f"{who}: friction = {friction[one]:g} {friction[two]:g} (anisotropic); the {which} two must be "
                        f"equal (MuJoCo takes its default for a second that is not given)"
                    )
            if m.pair_margin[p] < 0:
                out.append(f"{who}: margin = {m.pair_margin[p]:g} [m]; must be >= 0")
            for field, value in (
                ("solreffriction", _worst(m.pair_solreffriction[p])),
                ("gap", m.pair_gap[p]),
                ("adhesion", m.pair_adhesion[p]),
            ):
                if value:
                    out.append(f"{who}: {field} = {value:g}; must be 0")
        # Excluding a fixed body becomes excluding its geoms, and an exclusion looks among bodies first.
        moving = {self.body_names[b] for b in self.free + self.mocap}
        fixed = {b for pair in self._excluded() for b in pair if b in self.fixed}
        for label in sorted({self.labels[g] for b in fixed for g in self.geoms[b]} & moving):
            out.append(f"exclude of geom '{label}': a moving body has that name too; rename one")

    def _refuse_options(self, out):
        opt = self.m.opt
        integrator = _COMPILED_INTEGRATORS[int(opt.integrator)]
        if integrator.lower() not in (k.lower() for k in _INTEGRATORS):
            out.append(f"option integrator = {integrator.lower()}; must be {', '.join(_INTEGRATORS)}")
        for field, value in (
            ("density", opt.density),
            ("viscosity", opt.viscosity),
            ("noslip_iterations", opt.noslip_iterations),
        ):
            if value:
                what = "post-processing of friction" if field.startswith("noslip") else "forces of a fluid"
                out.append(f"option {field} = {value:g} ({what}); must be 0")
        for bit, what in ((_DISABLE.mjDSBL_CONTACT, "contact"), (_DISABLE.mjDSBL_CONSTRAINT, "constraint")):
            if opt.disableflags & bit:
                out.append(f"flag {what} = disable; set contype and conaffinity to 0 instead")
        for bit, what in (
            (_ENABLE.mjENBL_OVERRIDE, "override"),
            (_ENABLE.mjENBL_SLEEP, "sleep"),
            (_ENABLE.mjENBL_SPECULATIVE, "speculative"),
            (_ENABLE.mjENBL_DIAGEXACT, "diagexact"),
            (_ENABLE.mjENBL_IPC, "ipc"),
        ):
            if opt.enableflags & bit:
                out.append(f"flag {what} = enable; not simulated")

    # the scene

    def _find_key(self, keyframe):
        m = self.m
        names = [self._name(mujoco.mjtObj.mjOBJ_KEY, k) for k in range(m.nkey)]
        if keyframe is None:
            return 0 if m.nkey else None
        if keyframe is False:
            return None
        if isinstance(keyframe, str):
            if keyframe not in names:
                raise ValueError(f"keyframe = {keyframe!r} must be one of {names}")
            return names.index(keyframe)
        if keyframe is True or not isinstance(keyframe, (int, np.integer)):
            raise TypeError(f"keyframe = {keyframe!r} must be a name, an index, None or False")
        if not 0 <= keyframe < m.nkey:
            raise ValueError(f"keyframe = {keyframe} must be below the number of keyframes, {m.nkey}")
        return int(keyframe)

    def _excluded(self):
        """Pairs of body ids, as MuJoCo packs them."""
        return sorted({(int(s) >> 16, int(s) & 0xFFFF) for s in self.m.exclude_signature})

    def scene(self):
        """Build it. A coefficient that is 0 or beyond a geom's condim is absent where that changes no contact."""
        kept = set()
        while True:
            scene = self._assemble(kept)
            changed = self._wrong_friction(scene) - kept
            if not changed:
                return scene
            kept |= changed

    def _wrong_friction(self, scene):
        """(geom, coefficient) of pairs that differ from MuJoCo's: the larger value, if the larger condim has it."""
        m, r = self.m, resolve(scene)
        if not len(r.pairs):
            return set()
        ids = np.array(self.order)[np.stack(r.pair_sources(), axis=1)]
        out = set()
        for field, (ours, _) in _pair_coefficients(r).items():
            value = m.geom_friction[ids, GEOM_FRICTION[field]].max(1)
            wrong = np.where(m.geom_condim[ids].max(1) >= CONDIMS[field], value, 0.0) != ours
            wrong[[row for row in r.overrides]] = False
            out |= {(int(g), field) for g in ids[wrong].ravel()}
        return out

    def _assemble(self, kept):
        m = self.m
        geoms = {g: self._geom(g, kept) for g in self.order}
        # Nothing turns a body where nothing has friction, so that an angular velocity of zero is none.
        self.frictionless = not any(geom.friction is not None and self.collides[g] for g, geom in geoms.items())
        gravity = tuple(map(float, m.opt.gravity))
        if m.opt.disableflags & _DISABLE.mjDSBL_GRAVITY:
            gravity = None
        elif not any(gravity) and "gravity" not in self.keep and "rbd_gravity" not in self.numeric:
            gravity = None
        drag = self.numeric.get("rbd_drag", (None,))
        scene = Scene(
            bodies=[self._body(b, [geoms[g] for g in self.geoms[b]]) for b in self.free],
            kinematic=[self._mocap(b, [geoms[g] for g in self.geoms[b]]) for b in self.mocap],
            static=[geoms[g] for b in self.fixed for g in self.geoms[b]],
            gravity=gravity,
            dt=float(m.opt.timestep),
            drag=drag[0] if len(drag) == 1 else drag,
            name=m.names.split(b"\0")[0].decode(),
            integrator=_COMPILED_INTEGRATORS[int(m.opt.integrator)].lower(),
            impratio=float(m.opt.impratio),
            solver=_COMPILED_SOLVERS[int(m.opt.solver)].lower(),
            iterations=int(m.opt.iterations),
            tolerance=float(m.opt.tolerance),
            refsafe=not m.opt.disableflags & _DISABLE.mjDSBL_REFSAFE,
        )
        compiled = dataclasses.replace(scene, pairs=self._pairs())
        written = self._written_pairs()
        if written is None:
            return compiled
        try:
            authored = dataclasses.replace(scene, pairs=written)
            if _same_contacts(resolve(authored), resolve(compiled)):
                return authored
        except ValueError:
            pass
        if not kept:
            message = "custom text 'rbd_pairs' disagrees with the contact section and is ignored"
            warnings.warn(message, UserWarning, stacklevel=4)
        return compiled

    def _geom(self, g, kept):
        m, label = self.m, self.labels[g]
        body = int(m.geom_bodyid[g])
        pos, quat = m.geom_pos[g], m.geom_quat[g]
        while body in self.fixed and body != 0:  # into the world; exact where there is nothing to compose
            pos = _turn(m.body_quat[body], pos) + m.body_pos[body]
            quat = _times(m.body_quat[body], quat)
            body = int(m.body_parentid[body])
        condim = int(m.geom_condim[g])
        values = {f: float(m.geom_friction[g, k]) for f, k in GEOM_FRICTION.items()}
        hints = {f: self.numeric.get(f"rbd_{f}:{label}") for f in CONDIMS}
        hinted = {f for f, hint in hints.items() if hint is not None and _close(hint[0], values[f])}
        surface = self._present(values, condim, hinted | {f for f in CONDIMS if (g, f) in kept})
        natural = max([1, *(least for f, least in CONDIMS.items() if surface[f] is not None)])
        restitution = self.restitution
        if restitution is None:
            restitution = self.numeric.get(f"rbd_restitution:{label}", (None,))[0]
        unnamed = json.loads(self.text.get("rbd_unnamed", "[]"))
        name = self._name(mujoco.mjtObj.mjOBJ_GEOM, g)
        return Geom(
            shape=_SHAPES[int(m.geom_type[g])](m.geom_size[g]),
            pos=tuple(pos),
            quat=tuple(quat),
            **surface,
            restitution=restitution,
            group=int(m.geom_contype[g]),
            mask=int(m.geom_conaffinity[g]),
            name=None if name in unnamed else name,
            margin=max(float(m.geom_margin[g]), 0.0),  # negative only where nothing collides
            solref=tuple(m.geom_solref[g]),
            solimp=tuple(m.geom_solimp[g]),
            condim=condim if condim < natural else None,
            priority=int(m.geom_priority[g]),
        )

    def _present(self, values, condim, also=()):
        """Coefficients of friction: those up to the last that condim has and that is not 0, or is in ``also``."""
        zero = "friction" in self.keep
        there = [f in also or (condim >= least and (values[f] != 0 or zero)) for f, least in CONDIMS.items()]
        return {f: values[f] if any(there[k:]) else None for k, f in enumerate(CONDIMS)}

    def _body(self, b, geoms):
        m, name = self.m, self.body_names[b]
        q, v = m.jnt_qposadr[m.body_jntadr[b]], m.jnt_dofadr[m.body_jntadr[b]]
        qpos = m.qpos0 if self.key is None else m.key_qpos[self.key]
        qvel = np.zeros(m.nv) if self.key is None else m.key_qvel[self.key]
        pos, quat = tuple(qpos[q : q + 3]), tuple(qpos[q + 3 : q + 7])
        body = Body(name, geoms, pos=pos, quat=quat, **self._inertial(b, geoms))
        turn, com = rotation(body.quat), mass_properties(body)[1]
        omega = turn @ qvel[v + 3 : v + 6]
        vel = qvel[v : v + 3] + np.cross(omega, turn @ com)
        return dataclasses.replace(body, **self._velocity(name, vel, omega))

    def _velocity(self, name, vel, omega):
        hints = [self.numeric.get(f"rbd_{f}:{name}") for f in ("vel", "omega")]
        given = [np.zeros(3) if h is None else np.array(h) for h in hints]
        scale = np.abs([vel, omega, *given]).max()
        if np.abs(np.array(given) - [vel, omega]).max() <= AGREE * scale and ("rbd_jax" in self.text or any(hints)):
            return {"vel": hints[0], "omega": hints[1]}
        absent = self.frictionless and "omega" not in self.keep
        return {
            "vel": tuple(vel) if vel.any() or "vel" in self.keep else None,
            "omega": tuple(omega) if omega.any() or not absent else None,
        }

    def _inertial(self, b, geoms):
        """Mass, com and inertia; as the scene gave them, if that is the compiled body's."""
        m, name = self.m, self.body_names[b]
        full = _inertia_in_body(m.body_inertia[b], m.body_iquat[b])
        plain = full if _off_diagonal(full) > 0 else np.diag(full)
        compiled = {"mass": float(m.body_mass[b]), "com": tuple(m.body_ipos[b]), "inertia": plain.tolist()}
        if f"rbd_given:{name}" not in self.text:
            return compiled
        given = self.text[f"rbd_given:{name}"].split()
        fields = {f: v for f, v in {**compiled, **self._mass_hints(name)}.items() if f in given}
        try:
            mass, com, inertia = mass_properties(Body(name, geoms, **fields))
        except (ValueError, IndexError):
            return compiled
        extent = np.sqrt(np.abs(full).max() / compiled["mass"])
        same = (
            _close(mass, compiled["mass"])
            and np.abs(com - m.body_ipos[b]).max() <= AGREE * (extent + np.abs(com).max())
            and np.abs(inertia - full).max() <= AGREE * np.abs(full).max()
        )
        return fields if same else compiled

    def _mass_hints(self, name):
        hints = {f: self.numeric.get(f"rbd_{f}:{name}") for f in ("mass", "density", "com", "inertia")}
        hints = {f: h for f, h in hints.items() if h is not None}
        for f in ("mass", "density"):
            if f in hints:
                hints[f] = hints[f][0]
        if len(hints.get("inertia", ())) == 9:
            hints["inertia"] = np.reshape(hints["inertia"], (3, 3)).tolist()
        return hints

    def _mocap(self, b, geoms):
        m, name, i = self.m, self.body_names[b], self.m.body_mocapid[b]
        pos, quat = m.body_pos[b], m.body_quat[b]
        if self.key is not None:
            pos, quat = m.key_mpos[self.key][3 * i : 3 * i + 3], m.key_mquat[self.key][4 * i : 4 * i + 4]
        vel, omega = self.numeric.get(f"rbd_vel:{name}"), self.numeric.get(f"rbd_omega:{name}")
        return Body(name, geoms, pos=tuple(pos), quat=tuple(quat), vel=vel, omega=omega, **self._mass_hints(name))

    def _pairs(self):
        """Overrides and exclusions of the compiled contact section, on names that ``scene`` resolves."""
        m, out = self.m, []
        free = set(self.free)
        for b1, b2 in self._excluded():
            if free & {b1, b2}:
                one, two = ([self.labels[g] for g in self.geoms[b]] if b in self.fixed else [self.body_names[b]]
                            for b in (b1, b2))  # fmt: skip
                out += [Pair(x, y, exclude=True) for x in one for y in two]
        for p in range(m.npair):
            g1, g2 = int(m.pair_geom1[p]), int(m.pair_geom2[p])
            bodies = {int(m.geom_bodyid[g1]), int(m.geom_bodyid[g2])}
            if not free & bodies or len(bodies) == 1:
                continue
            values = {f: float(m.pair_friction[p, k]) for f, k in PAIR_FRICTION.items()}
            out.append(
                Pair(
                    self.labels[g1], self.labels[g2], **self._present(values, int(m.pair_dim[p])),
                    margin=float(m.pair_margin[p]), solref=tuple(m.pair_solref[p]), solimp=tuple(m.pair_solimp[p]),
                )
            )  # fmt: skip
        return out

    def _written_pairs(self):
        if "rbd_pairs" not in self.text:
            return None
        return [Pair(**entry) for entry in json.loads(self.text["rbd_pairs"])]


def _worst(*values):
    """The largest magnitude, 0 if all are 0."""
    return max(float(np.abs(v).max(initial=0.0)) for v in values)


def _close(a, b):
    return abs(a - b) <= AGREE * max(abs(a), abs(b))


def _same_contacts(a: ResolvedScene, b: ResolvedScene) -> bool:
    """Whether both have the same pairs with the same numbers, as far as MJCF knows them."""
    if not np.array_equal(a.pairs, b.pairs):
        return False
    ours, theirs = ((*(v for v, _ in _pair_coefficients(r).values()), *r.pair_softness()) for r in (a, b))
    return all(np.allclose(x, y, rtol=AGREE, atol=1e-300) for x, y in zip(ours, theirs))


def _pair_coefficients(r: ResolvedScene) -> dict:
    """Values and presence of each coefficient of friction."""
    return {f: getattr(r, "pair_" + f)() for f in CONDIMS}


def _times(p, q):
    out = np.zeros(4)
    mujoco.mju_mulQuat(out, p, q)
    return out


def _turn(quat, v):
    out = np.zeros(3)
    mujoco.mju_rotVecQuat(out, np.array(v), quat)
    return out


def _inertia_in_body(principal, quat):
    """(3, 3) inertia in body axes; exact where the principal axes are body axes or all moments are equal."""
    if len(set(principal.tolist())) == 1:
        return np.diag(principal)
    r = rotation(quat)
    r = np.where(np.abs(r - np.round(r)) <= ROUNDING, np.round(r), r)
    full = r @ np.diag(principal) @ r.T
    full = (full + full.T) / 2
    if _off_diagonal(full) <= 8 * np.finfo(float).eps * principal.max():
        full = np.diag(np.diag(full))
    return full


def _off_diagonal(full):
    return np.abs(full - np.diag(np.diag(full))).max()


# ---------------------------------------------------------------------------------------------------------
# Out
# ---------------------------------------------------------------------------------------------------------


def to_mjcf(scene: Scene) -> str:
    """Return MJCF text of a scene: a model MuJoCo simulates as it is, from which ``load_mjcf`` restores the scene.

    Every number is written with 17 digits. Masses and inertias are explicit; a start that is not at rest is the
    keyframe ``start``; frictionless geoms have condim 1; cone elliptic, Jacobian dense. The velocity of kinematic
    bodies, restitution and drag have no MuJoCo field and are only under ``<custom>``.
    A ``Body.friction`` or ``.restitution`` shorthand comes back as that of its geoms.
    """
    r = resolve(scene)
    root = ET.Element("mujoco", model=scene.name)
    _write_option(root, scene)
    custom = _Custom()
    world = ET.SubElement(root, "worldbody")
    _write_geoms(world, r, STATIC, -1)
    qpos, qvel = [], []
    for i, body in enumerate(scene.bodies):
        element = _write_body(world, body)
        ET.SubElement(element, "freejoint", align="false")
        _write_inertial(element, r.mass[i], r.com[i], r.inertia[i])
        _write_geoms(element, r, DYNAMIC, i)
        qpos += [*body.pos, *body.quat]
        qvel += _to_qvel(r.quat[i], r.com[i], r.vel[i], r.omega[i])
        _write_body_custom(custom, body, kinematic=False)
    mpos, mquat = [], []
    for i, body in enumerate(scene.kinematic):
        element = _write_body(world, body, mocap="true")
        _write_geoms(element, r, KINEMATIC, i)
        mpos += body.pos
        mquat += body.quat
        _write_body_custom(custom, body, kinematic=True)
    _write_geom_custom(custom, r)
    if scene.drag is not None:
        custom.numeric["rbd_drag"] = scene.drag
    if scene.gravity is not None and not any(scene.gravity):
        custom.numeric["rbd_gravity"] = scene.gravity
    _write_contact(root, r, custom)
    custom.write(root)
    if any(qvel):
        frame = ET.SubElement(root, "keyframe")
        key = ET.SubElement(frame, "key", name=START_KEY, qpos=_digits(qpos), qvel=_digits(qvel))
        if mpos:
            key.set("mpos", _digits(mpos))
            key.set("mquat", _digits(mquat))
    ET.indent(root)
    return ET.tostring(root, encoding="unicode") + "\n"


def compile_mujoco(scene: Scene) -> tuple[mujoco.MjModel, mujoco.MjData]:
    """Return MuJoCo's model of a scene and its data at the start state, after one ``mj_forward``.

    MuJoCo 4.0.1 raises ``FatalError`` ("broadphase buffer full") where two or more of world and mocap bodies
    hold planes and two or more bodies move; rbd_jax simulates such scenes.
    """
    model = mujoco.MjModel.from_xml_string(to_mjcf(scene))
    data = mujoco.MjData(model)
    if model.nkey:
        mujoco.mj_resetDataKeyframe(model, data, 0)
    mujoco.mj_forward(model, data)
    return model, data


class _Custom:
    """The ``<custom>`` section."""

    def __init__(self):
        self.numeric, self.text = {}, {"rbd_jax": FORMAT}

    def write(self, root):
        element = ET.SubElement(root, "custom")
        for name, value in self.numeric.items():
            ET.SubElement(element, "numeric", name=name, data=_digits(value))
        for name, value in self.text.items():
            ET.SubElement(element, "text", name=name, data=value)


def _digits(values):
    values = np.ravel(values)
    return " ".join(repr(float(v)) for v in values)


def _write_option(root, scene):
    names = {v: k for k, v in (_INTEGRATORS | _SOLVERS).items()}
    option = ET.SubElement(
        root, "option", timestep=_digits(scene.dt), gravity=_digits(scene.gravity or (0, 0, 0)),
        integrator=names[scene.integrator], cone=scene.cone, impratio=_digits(scene.impratio), jacobian="dense",
        solver=names[scene.solver], iterations=str(scene.iterations), tolerance=_digits(scene.tolerance),
    )  # fmt: skip
    if not scene.refsafe:
        ET.SubElement(option, "flag", refsafe="disable")


def _write_body(world, body, **attributes):
    return ET.SubElement(world, "body", name=body.name, pos=_digits(body.pos), quat=_digits(body.quat), **attributes)


def _write_geoms(parent, r, category, body):
    for g in np.flatnonzero((r.geom_category == category) & (r.geom_body == body)):
        shape = r.geom_shapes[g]
        element = ET.SubElement(
            parent, "geom", name=r.geom_names[g], type=shape.kind, size=_digits(_mujoco_size(shape)),
            pos=_digits(r.geom_pos[g]), quat=_digits(r.geom_quat[g]),
            friction=_digits([getattr(r, "geom_" + f)[g] for f in GEOM_FRICTION]), condim=str(r.geom_condim[g]),
            contype=str(r.geom_group[g]), conaffinity=str(r.geom_mask[g]), margin=_digits(r.geom_margin[g]),
            solref=_digits(r.geom_solref[g]), solimp=_digits(r.geom_solimp[g]),
        )  # fmt: skip
        if r.geom_priority[g]:
            element.set("priority", str(r.geom_priority[g]))


def _mujoco_size(shape: Shape):
    return (0.0, 0.0, 1.0) if isinstance(shape, Plane) else shape.size  # infinite, grid of 1 m


def _write_inertial(element, mass, com, inertia):
    quat = np.array([1.0, 0.0, 0.0, 0.0])
    if _off_diagonal(inertia) == 0:
        moments = np.diag(inertia).copy()
    else:
        moments, axes = np.linalg.eigh(inertia)
        axes[:, 0] *= np.sign(np.linalg.det(axes))
        mujoco.mju_mat2Quat(quat, axes.ravel())
        quat /= np.linalg.norm(quat)
    # A flat body lies on the bound of the triangle inequality, and MuJoCo refuses one that rounding has broken.
    top = int(np.argmax(moments))
    one, two = (top + 1) % 3, (top + 2) % 3
    lack = moments[top] - (moments[one] + moments[two])
    if lack > -4 * np.finfo(float).eps * moments[top]:
        moments[one] += max(lack, 0.0) + 4 * np.finfo(float).eps * moments[top]
    ET.SubElement(
        element, "inertial", pos=_digits(com), mass=_digits(mass), diaginertia=_digits(moments), quat=_digits(quat)
    )


def _to_qvel(quat, com, vel, omega):
    """MuJoCo's six numbers: velocity of the frame's origin (world), angular velocity (body)."""
    turn = rotation(quat)
    return [*(vel - np.cross(omega, turn @ com)), *(turn.T @ omega)]


def _write_body_custom(custom, body, kinematic):
    for field in ("vel", "omega"):
        if getattr(body, field) is not None:
            custom.numeric[f"rbd_{field}:{body.name}"] = getattr(body, field)
    given = [f for f in ("mass", "density", "com", "inertia") if getattr(body, f) is not None]
    for f in given:
        # mass and com of a dynamic body have fields of their own
        if kinematic or f in ("density", "inertia"):
            custom.numeric[f"rbd_{f}:{body.name}"] = getattr(body, f)
    if not kinematic:
        custom.text[f"rbd_given:{body.name}"] = " ".join(given) or "none"


def _write_geom_custom(custom, r):
    scene = r.scene
    names = [g.name for b in scene.bodies + scene.kinematic for g in b.geoms] + [g.name for g in scene.static]
    unnamed = [label for label, name in zip(r.geom_names, names) if name is None]
    if unnamed:
        custom.text["rbd_unnamed"] = json.dumps(unnamed)
    for g, label in enumerate(r.geom_names):
        if r.geom_has_restitution[g]:
            custom.numeric[f"rbd_restitution:{label}"] = r.geom_restitution[g]
        for field, least in CONDIMS.items():
            value = getattr(r, "geom_" + field)[g]
            if getattr(r, "geom_has_" + field)[g] and (value == 0 or r.geom_condim[g] < least):
                custom.numeric[f"rbd_{field}:{label}"] = value


def _write_contact(root, r, custom):
    """Overrides as full pairs. MJCF excludes whole bodies only, so what else these two touch is paired too."""
    scene = r.scene
    if not scene.pairs:
        return
    every = resolve(dataclasses.replace(scene, pairs=())).pairs.tolist()
    left = {tuple(p): row for row, p in enumerate(r.pairs.tolist())}
    body_of = [(int(c), int(b)) for c, b in zip(r.geom_category, r.geom_body)]
    cut = {(body_of[a], body_of[b]) for a, b in every if (a, b) not in left}
    element = ET.SubElement(root, "contact")
    for one, two in sorted(cut):
        ET.SubElement(element, "exclude", body1=_body_name(scene, one), body2=_body_name(scene, two))
    mu, spin, roll = (value for value, _ in _pair_coefficients(r).values())
    condim = r.pair_condim()
    margin, solref, solimp = r.pair_softness()
    for (a, b), row in left.items():
        if row not in r.overrides and (body_of[a], body_of[b]) not in cut:
            continue
        ET.SubElement(
            element, "pair", geom1=r.geom_names[a], geom2=r.geom_names[b], condim=str(condim[row]),
            friction=_digits([v[row] for v in (mu, mu, spin, roll, roll)]), margin=_digits(margin[row]),
            solref=_digits(solref[row]), solimp=_digits(solimp[row]),
        )  # fmt: skip
    plain = Pair("a", "b")
    custom.text["rbd_pairs"] = json.dumps(
        [{k: v for k, v in vars(p).items() if k in ("a", "b") or v != getattr(plain, k)} for p in scene.pairs]
    )


def _body_name(scene, key):
    category, i = key
    if category == STATIC:
        return "world"
    return (scene.kinematic if category == KINEMATIC else scene.bodies)[i].name
