"""edslam simulate --scene office0 --out DIR

Write a simulated recording (events, depth, grey images, true poses) in EventReplica's layout to DIR. With
--mesh FILE --trajectory TUM.txt any textured or vertex-coloured mesh (obj, ply, glb) takes the place of the
built-in rooms room0, room2, office0, office2, office3, which are procedural stand-ins, not Replica.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal

from edslam_ti.arguments import read_options
from edslam_ti.cold_start import load_kernels
from edslam_ti.errors import plain
from edslam_ti.simulation.settings import SimulationConfig

Vector = tuple[float, float, float]


class SimulateOptions(SimulationConfig):
    """What to record; the recording's own settings besides."""

    out: Path
    """New or empty folder that receives the recording; an older recording there is replaced."""
    scene: str | None = None
    """Built-in room (room0, room2, office0, office2, office3) or wall, corridor, kitchen, ..."""
    mesh: Path | None = None
    """Textured or vertex-coloured mesh file instead of a room."""
    mesh_scale: float = 1.0
    """Factor from the mesh's unit to metres."""
    trajectory: Path | None = None
    """Camera-to-world path, TUM format; rooms have a path of their own."""
    trajectory_scale: float = 1.0
    """Factor on the trajectory's positions about its first."""
    trajectory_start: float = 0.0
    """Seconds of the trajectory to skip."""
    position: Vector | None = None
    """Where the trajectory's first camera is put (metres; with --look-at)."""
    look_at: Vector | None = None
    """Point it then looks at (metres)."""
    up: Literal["x", "-x", "y", "-y", "z", "-z"] = "z"
    """The scene's axis that points up, for --look-at."""
    threads: int = 2
    """CPU threads."""

    @property
    def settings(self) -> SimulationConfig:
        """The recording's own settings."""
        return SimulationConfig(**{name: getattr(self, name) for name in SimulationConfig.model_fields})


def main(argv: Sequence[str] | None = None) -> None:
    """Simulate a recording."""
    options = read_options(SimulateOptions, argv, "edslam simulate", __doc__)
    load_kernels()
    from rich.markup import escape
    from rich.progress import Progress

    from edslam_ti.simulation.catalogue import ROOM_NAMES
    from edslam_ti.simulation.command import Placement, record

    start, scale = options.trajectory_start, options.trajectory_scale
    name = options.mesh.name if options.mesh else options.scene
    with Progress(transient=True) as bar:
        task = bar.add_task(f"simulating {escape(plain(name))}", total=1.0)
        written = record(
            scene_name=options.scene,
            mesh=options.mesh,
            mesh_scale=options.mesh_scale,
            trajectory=options.trajectory,
            placement=Placement(options.position, options.look_at, options.up, scale, start),
            config=options.settings,
            out=options.out,
            threads=options.threads,
            progress=lambda share: bar.update(task, completed=share),
        )
    print(
        f"{plain(written.folder, 4096)}: {written.duration:g} s, {written.num_events} events, "
        f"{written.num_depth_images} depth images, {written.num_images} images"
    )
    if options.scene in ROOM_NAMES:
        print(f"'{options.scene}' is a procedural stand-in for EventReplica's scene, not Replica")
