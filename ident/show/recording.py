"""recording.rrd: the arm moving, torques before and after, FRFs and the verdict, in rerun."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pinocchio as pin
import rerun as rr
import rerun.blueprint as rrb

from ident.chain import build_structure, tell_links_apart
from ident.show.figures import frf_picture, rounded, shown_joints
from ident.units import response_unit, torque_unit, unit_suffix, units_of_torques
from ident.verdict import Diagnosis, TorqueTrace
from robot_assets.errors import DataError
from robot_assets.robot import Robot
from robot_assets.urdf import completed

FOOTER = 32  # bytes at the end of a recording, its mark among them
FRAMES_PER_SECOND = 30.0
COLORS = {"measured": [150, 150, 150], "before": [200, 85, 61], "after": [42, 127, 158]}


def check_recording(path: Path) -> None:
    """Raise a DataError where a file is no whole recording; the viewer would show an empty window."""
    try:
        with path.open("rb") as file:
            start, end = file.read(4), path.stat().st_size - FOOTER
            file.seek(max(end, 0))
            whole = start == b"RRF2" and b"RRF2FOOT" in file.read()
    except OSError as err:
        raise DataError(
            "recording", str(path), str(err.strerror or err), "the recording.rrd of `simgap diagnose`"
        ) from err
    if not whole:
        raise DataError("recording", str(path), "no whole recording of rerun", "the recording.rrd of `simgap diagnose`")


def write_recording(diagnosis: Diagnosis, path: Path) -> None:
    """Write the recording with its blueprint."""
    stream = rr.RecordingStream("simgap", recording_id=diagnosis.verdict.dataset)
    stream.save(str(path), default_blueprint=_blueprint(diagnosis))
    stream.log("verdict", rr.TextDocument(_markdown(diagnosis), media_type=rr.MediaType.MARKDOWN), static=True)
    if diagnosis.traces:
        trace = diagnosis.traces[0]
        _log_torques(stream, trace, diagnosis.joints)
        _log_arm(stream, diagnosis, trace)
    for view in diagnosis.frf[:1]:
        picture = frf_picture(view, diagnosis.joints, _shown_joints(diagnosis)[:2], response_unit(diagnosis.robot))
        stream.log("frf", rr.EncodedImage(contents=picture, media_type="image/png"), static=True)
    stream.flush()
    stream.disconnect()


def _blueprint(diagnosis: Diagnosis) -> rrb.Blueprint:
    joints = _shown_joints(diagnosis)
    unit = units_of_torques(diagnosis.robot)
    torques = [
        rrb.TimeSeriesView(origin=f"torque/{part(joints[0])}", name=f"{joints[0]}: motor torque, {unit[joints[0]]}")
    ]
    torques += [
        rrb.TimeSeriesView(origin=f"error/{part(name)}", name=f"{name}: torque error, {unit[name]}") for name in joints
    ]
    responses = [rrb.Spatial2DView(origin="frf", name=f"FRF at {view.operating_point}") for view in diagnosis.frf[:1]]
    left = rrb.Vertical(
        rrb.TextDocumentView(origin="verdict", name="verdict"),
        rrb.Spatial3DView(origin="arm", name="arm", eye_controls=_eye(diagnosis)),
        row_shares=[2, 3],
    )
    right = rrb.Vertical(*torques, *responses, row_shares=[1.0] * len(torques) + [1.6] * len(responses))
    return rrb.Blueprint(rrb.Horizontal(left, right, column_shares=[2, 3]), collapse_panels=True)


def _eye(diagnosis: Diagnosis) -> rrb.EyeControls3D | None:
    """A view from the side of the arm that holds its whole motion."""
    if not diagnosis.traces:
        return None
    structure = build_structure(diagnosis.robot)
    data, q = structure.model.createData(), np.zeros(structure.model.nq)
    trace = diagnosis.traces[0].q
    places = []
    for row in trace[:: max(1, len(trace) // 50)]:
        q[structure.driven] = row
        pin.forwardKinematics(structure.model, data, q)
        places.append([M.translation.copy() for M in data.oMi])
    points = np.array(places)
    low, high = points.min(axis=(0, 1)), points.max(axis=(0, 1))
    x, y = (points[:, -1] - points[:, 0]).mean(axis=0)[:2]
    aside = np.array([y, -x, 0.0]) if np.hypot(x, y) > 1e-3 else np.array([1.0, -1.0, 0.0])
    direction = aside / np.linalg.norm(aside) + [0.0, 0.0, 0.35]
    centre = (low + high) / 2
    distance = 1.3 * max(float(np.linalg.norm(high - low)), 0.4)
    return rrb.EyeControls3D(position=centre + distance * direction, look_target=centre, eye_up=[0.0, 0.0, 1.0])


def _shown_joints(diagnosis: Diagnosis) -> list[str]:
    return shown_joints(diagnosis.verdict, next(iter(diagnosis.traces), None), diagnosis.joints)


def _markdown(diagnosis: Diagnosis) -> str:
    v = diagnosis.verdict
    rows = [f"## {v.sentence}", ""]
    for c in v.causes:
        values = ", ".join(f"{k} = {rounded(x.value, x.std)}{unit_suffix(x.unit)}" for k, x in c.parameters.items())
        rows += [
            f"**{c.effect.replace('_', ' ')} at {c.joint}**, probability {c.probability:.3f}: {values}",
            "",
            c.evidence,
            "",
        ]
    if v.gain is not None:
        g, unit = v.gain, torque_unit(diagnosis.robot, v.gain.joints)
        ends = g.interval_told
        interval = "" if ends is None else f" (95 % interval {ends[0]:.1%} to {ends[1]:.1%} of the gap closed)"
        rows.append(
            f"Torque error on held-out data {g.before:.3g} → {g.after:.3g} {unit}, noise {g.noise_floor:.3g} {unit}{interval}."
        )
    if v.next_experiment:
        rows.append(f"\n**Next experiment.** {v.next_experiment}")
    rows.append(f"\nUnexplained: {v.unexplained_verdict} ({v.unexplained_share:.1%}).")
    return "\n".join(rows)


def part(name: str) -> str:
    """A joint or a link in the path of an entity, whatever signs its name has."""
    return rr.escape_entity_path_part(name)


def _log_torques(stream: rr.RecordingStream, trace: TorqueTrace, joints: tuple[str, ...]) -> None:
    """Torques and their errors. The viewer draws in the order of the paths, and the last one, ``after``, on top."""
    step = max(1, len(trace.t) // 4000)
    times = [rr.TimeColumn("time", duration=trace.t[::step])]
    models = {"before": trace.before, "after": trace.after}
    for j, name in enumerate(joints):
        torques = {"measured": trace.measured, **models}
        errors = {kind: trace.measured - values for kind, values in models.items()}
        for what, curves in (("torque", torques), ("error", errors)):
            for place, (kind, values) in enumerate(curves.items(), 1):
                entity = f"{what}/{part(name)}/{place}_{kind}"
                stream.log(entity, rr.SeriesLines(colors=COLORS[kind], names=kind, widths=1.5), static=True)
                stream.send_columns(entity, times, rr.Scalars.columns(scalars=values[::step, j]))


def _log_arm(stream: rr.RecordingStream, diagnosis: Diagnosis, trace: TorqueTrace) -> None:
    """Link frames and meshes along the motor motion, by forward kinematics of the rigid chain."""
    robot = diagnosis.robot
    structure = build_structure(robot)
    model, data = structure.model, structure.model.createData()
    step = max(1, int(1 / FRAMES_PER_SECOND / max(trace.t[1] - trace.t[0], 1e-9)))
    times = trace.t[::step]
    meshes = _log_meshes(stream, robot)
    track = np.empty((len(times), model.njoints, 3))
    rotations = np.empty((len(times), model.njoints, 4))
    for i, q in enumerate(trace.q[::step]):
        full = np.zeros(model.nq)
        full[structure.driven] = q
        pin.forwardKinematics(model, data, full)
        track[i] = [M.translation for M in data.oMi]
        rotations[i] = [pin.Quaternion(M.rotation).coeffs() for M in data.oMi]
    column = [rr.TimeColumn("time", duration=times)]
    for k in range(1, model.njoints):
        name = model.names[k]
        stream.send_columns(
            f"arm/{part(name)}", column, rr.Transform3D.columns(translation=track[:, k], quaternion=rotations[:, k])
        )
    if not meshes:
        for i, t in enumerate(times):
            stream.set_time("time", duration=t)
            stream.log("arm/skeleton", rr.LineStrips3D([track[i]], radii=0.02, colors=[90, 100, 110]))


def _log_meshes(stream: rr.RecordingStream, robot: Robot) -> bool:
    """Collision meshes under the driven joints that carry them; False where no file is found."""
    try:
        text = completed(robot.urdf)
        full = pin.buildModelFromXML(text)
        shapes = pin.buildGeomFromUrdfString(
            full, text, pin.GeometryType.COLLISION, package_dirs=[str(robot.mesh_dir or robot.folder)]
        )
        tell_links_apart(full)
        fixed = [full.getJointId(name) for name in full.names[1:] if name not in robot.joint_names]
        full, shapes = pin.buildReducedModel(full, shapes, fixed, _locked(full, robot))
    except Exception:  # Pinocchio raises many types for URDFs whose meshes are not there
        return False
    found = False
    for shape in shapes.geometryObjects:
        file = Path(shape.meshPath)
        if file.suffix.lower() not in (".stl", ".obj", ".glb") or not file.is_file():
            continue
        joint = full.names[shape.parentJoint]
        parent = f"arm/{part(joint)}" if shape.parentJoint else "arm/base"
        entity = f"{parent}/{part(shape.name)}"
        M = shape.placement
        stream.log(
            entity,
            rr.Transform3D(
                translation=M.translation, quaternion=pin.Quaternion(M.rotation).coeffs(), scale=shape.meshScale
            ),
            static=True,
        )
        stream.log(f"{entity}/mesh", rr.Asset3D(path=file, albedo_factor=[170, 180, 190, 255]), static=True)
        found = True
    return found


def _locked(model: pin.Model, robot: Robot) -> np.ndarray:
    """Neutral configuration with the locked joints in place."""
    q = pin.neutral(model)
    for name, value in robot.locked.items():
        joint = model.joints[model.getJointId(name)]
        q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
    return q
