"""Exported models read by libsdformat, Gazebo's own reader, through Drake's Python: `make sdf`.

libsdformat refuses what is not SDFormat; what Drake makes of the rest is held against the model:
the rigid body's inertia about the link's origin, and volume and centre of the box that floats it.
Drake warns that it does not know the hydrodynamics plugin.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from pydrake.multibody.parsing import Parser
from pydrake.multibody.plant import AddMultibodyPlantSceneGraph
from pydrake.systems.framework import DiagramBuilder

from rov_ident import config as configuration
from rov_ident.config import Config
from rov_ident.consumer.formats import export
from rov_ident.core.frames import FLIP_BODY

_FLIP = np.tile(FLIP_BODY, 2)


def check(config: Config, path: Path) -> None:
    """Read ``path`` and hold it against ``config``; raises where they differ."""
    plant, scene = AddMultibodyPlantSceneGraph(DiagramBuilder(), time_step=0.0)
    Parser(plant).AddModels(str(path))
    body = plant.GetBodyByName("base_link")
    read = body.default_spatial_inertia().CopyToFullMatrix6()  # moments first, forces last
    expected = config.dynamics.body.mass_matrix * np.outer(_FLIP, _FLIP)
    np.testing.assert_allclose(np.roll(read, (3, 3), (0, 1)), expected, rtol=1e-9, atol=1e-12)

    (shape,) = plant.GetCollisionGeometriesForBody(body)
    inspector = scene.model_inspector()
    lift = np.prod(inspector.GetShape(shape).size()) * 1000.0 * config.gravity
    rigid = config.dynamics.body
    assert np.isclose(lift - config.gravity * rigid.mass, rigid.buoyancy - rigid.weight)
    centre = inspector.GetPoseInFrame(shape).translation()
    np.testing.assert_allclose(centre, FLIP_BODY * rigid.cob, atol=1e-12)


def main() -> None:
    with TemporaryDirectory() as folder:
        for source in sorted(Path("config").glob("*.yaml")):
            config = configuration.load(source)
            lopsided = configuration.to_parameters(config)
            lopsided["vehicle"] |= {"cog": [0.03, -0.01, 0.02], "cob": [0.01, 0.02, -0.03]}
            for one in (config, configuration.from_parameters(lopsided)):
                path = Path(folder) / "model.sdf"
                path.write_text(export(one, "gazebo").content, encoding="utf-8")
                check(one, path)
            print(f"{source}: as exported")


if __name__ == "__main__":
    main()
