"""Scene files of a small rig."""

DISPLACEMENT_VOXEL = (0.8, -0.6, 0.4)
VOXEL_MM = 0.1
DT_S = 1e-3

CAMERA = """
[[camera]]
name = "{name}"
focal_length_mm = 100.0
magnification = -1.0
f_number = 4.0
microlens_pitch_mm = 0.1
microlens_focal_length_mm = 0.8
pixel_um = 8.0
sensor_width_px = 360
sensor_height_px = 360
nominal_angle_deg = {angle}
true_yaw_deg = {true_angle}
true_array_roll_deg = 0.05
"""

SCENE = """
name = "contract"
seed = 3
dt_s = 1e-3
{cameras}
[board]
dots = [5, 5]
spacing_mm = 0.45
dot_diameter_mm = 0.1
planes_mm = [-0.6, 0.0, 0.6]

[volume]
size_mm = [1.8, 1.8, 1.2]
voxel_mm = 0.1

[particles]
sigma_mm = 0.06
{particles}

[flow]
kind = "uniform"
displacement_mm = [0.08, -0.06, 0.04]

[smart]
iterations = 8

[correlation]
windows = [[12, 12, 12], [8, 10, 10]]

[network]
hidden = [12]
epochs = 60
"""

PAIRS = "count = 60\npairs = 2"
INSTANTS = (
    'count = 36\ninstants = 4\n\n[[wall]]\nkind = "half_space"\npoint_mm = [0.0, -0.1, 0.0]\nnormal = [0.0, 1.0, 0.0]'
)


def simulate(command, folder, particles):
    """Simulate pairs or instants by a function that runs the command line; return the experiment, with tracking."""
    angles = {"left": 40.0, "right": -40.0}
    cameras = "".join(CAMERA.format(name=name, angle=a, true_angle=a - 0.5) for name, a in angles.items())
    file = folder / "scene.toml"
    file.write_text(SCENE.format(cameras=cameras, particles=particles), "utf-8")
    command("simulate", file, "--out", folder / "data")
    experiment = folder / "data" / "experiment.toml"
    experiment.write_text(experiment.read_text("utf-8") + "\n[tracking]\nrounds = 3\n", "utf-8")
    return experiment
