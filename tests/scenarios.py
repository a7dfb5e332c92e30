"""Texts of small scenarios without data products, for tests of several packages."""

_WINDOW = """
[window]
search = "none"
start = "2029-08-07T01:40:00Z"
duration_s = {duration_s}
[terrain]
source = "procedural"
"""
SELENITA = """name = "selenita"
[spacecraft]
id = 76
[camera]
fov_deg = 120.0
width_px = 512
height_px = 512
"""
SYNTHETIC = f"""{SELENITA}pointing = "nadir"
k1 = 0.0
[frames]
orientation = "IAU WGCCRE 2009"
gravity_field = "GRGM1200L (12x12, built in)"
"""
"""Of synthetic passes."""
GOLDEN = f"""{SYNTHETIC}[reference]
sigma_rtn_m = [3.0, 4.0, 0.0]
[evidence]
world = "real-terrain"
unseen_share = 0.25
[experiment]
orbit_error_m = 1000.0
[requirements]
estimator = "spherical"
median_error_m = 129.0
p95_error_m = 131.0
better_than = ["propagate-only"]
packets_percent = 100.0
frames_percent = 100.0
images_percent = 100.0
recall = 0.5
precision = 0.5
anchor_reads = 0.0
resets = 0.0
temperature_max_c = 21.0
cpu_percent = 50.0
"""
_FILTER = """filter_gravity = "builtin"
filter_degree = 8
"""


def live_scenario(name, seed, duration_s):
    """Return a window of reduced images for the spherical estimator in gravity of degree 8."""
    return (
        f'name = "{name}"\nseed = {seed}\n[dynamics]\ngravity = "builtin"\ndegree = 8\norientation = "iau"'
        f'{_WINDOW.format(duration_s=duration_s)}[camera]\nimages = "reduced"\n'
        f'[navigation]\nestimators = ["spherical"]\n{_FILTER}'
    )


def still_scenario(name, duration_s, seed=7):
    """Return a window of rendered images in the built-in gravity field; further sections may follow."""
    return (
        f'name = "{name}"\nseed = {seed}\n[dynamics]\ngravity = "builtin"\norientation = "iau"'
        f"{_WINDOW.format(duration_s=duration_s)}"
    )


def short_scenario(duration_s, estimators='estimators = ["anchored"]\n'):
    """Return a window of a few rendered images; it ends in the section `navigation`."""
    return f"{still_scenario('short', duration_s)}[navigation]\n{estimators}{_FILTER}"


def commanded_scenario(name, further=""):
    """Return a flight of reduced images whose windows the ground commands."""
    return f"""
name = "{name}"
seed = 3
[orbit]
epoch = "2029-08-07T00:00:00Z"
[dynamics]
gravity = "builtin"
degree = 8
[window]
search = "none"
duration_s = 60.0
[camera]
images = "reduced"
[terrain]
source = "procedural"
[navigation]
estimators = ["spherical"]
{further}"""
