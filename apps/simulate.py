"""python apps/simulate.py --scene office0 --out DIR

Write a simulated recording (events, depth, grey images, true poses) in EventReplica's layout to DIR. With
--mesh FILE --trajectory TUM.txt any textured or vertex-coloured mesh (obj, ply, glb) takes the place of the
built-in rooms room0, room2, office0, office2, office3, which are procedural stand-ins, not Replica.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Literal

import tyro
from rich.markup import escape
from rich.progress import Progress

from edslam_ti.command_line import launch, parse_arguments
from edslam_ti.errors import plain
from edslam_ti.simulation.catalogue import ROOM_NAMES
from edslam_ti.simulation.command import Placement, record
from edslam_ti.simulation.settings import SimulationConfig


def simulate(
    out: Path,
    settings: Annotated[SimulationConfig, tyro.conf.arg(name="")],
    scene: str | None = None,
    mesh: Path | None = None,
    mesh_scale: float = 1.0,
    trajectory: Path | None = None,
    trajectory_scale: float = 1.0,
    trajectory_start: float = 0.0,
    position: tuple[float, float, float] | None = None,
    look_at: tuple[float, float, float] | None = None,
    up: Literal["x", "-x", "y", "-y", "z", "-z"] = "z",
    threads: int = 2,
) -> None:
    """Simulate a recording.

    Args:
        out: new or empty folder that receives the recording; an older recording there is replaced
        scene: built-in room (room0, room2, office0, office2, office3) or wall, corridor, kitchen, ...
        mesh: textured or vertex-coloured mesh file instead of a room
        mesh_scale: factor from the mesh's unit to metres
        trajectory: camera-to-world path, TUM format; rooms have a path of their own
        trajectory_scale: factor on the trajectory's positions about its first
        trajectory_start: seconds of the trajectory to skip
        position: where the trajectory's first camera is put (metres; with --look-at)
        look_at: point it then looks at (metres)
        up: the scene's axis that points up, for --look-at
        threads: CPU threads
    """
    placement = Placement(position, look_at, up, trajectory_scale, trajectory_start)
    with Progress(transient=True) as bar:
        task = bar.add_task(f"simulating {escape(plain(mesh.name if mesh else str(scene)))}", total=1.0)
        written = record(
            scene_name=scene,
            mesh=mesh,
            mesh_scale=mesh_scale,
            trajectory=trajectory,
            placement=placement,
            config=settings,
            out=out,
            threads=threads,
            progress=lambda share: bar.update(task, completed=share),
        )
    print(
        f"{plain(written.folder, 4096)}: {written.duration:g} s, {written.num_events} events, "
        f"{written.num_depth_images} depth images, {written.num_images} images"
    )
    if scene in ROOM_NAMES:
        print(f"'{scene}' is a procedural stand-in for EventReplica's scene, not Replica")


def main(argv: Sequence[str] | None = None) -> None:
    parse_arguments(simulate, argv, description=__doc__)


if __name__ == "__main__":
    launch(main)
