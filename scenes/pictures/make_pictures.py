"""Make the pictures of the README: run each scene and show some of its frames side by side.

python scenes/pictures/make_pictures.py
"""

import tempfile
from pathlib import Path

import warpjelly as wj
from warpjelly.preview import render_preview

HERE = Path(__file__).parent
# The frames that tell a scene's story.
FRAMES = {
    "tree_drop": [0, 25, 38, 78, 299],
    "jello_cube": [0, 30, 64, 200, 299],
    "cube_on_sphere": [0, 36, 56, 76, 130],
    "u_on_sphere": [0, 33, 45, 80, 239],
    "coupler_drop": [0, 17, 24, 51, 119],
    "three_networks": [0, 20, 30, 60, 179],
    "pile": [0, 22, 36, 60, 119],
    "falling_cloth": [0, 17, 24, 35, 149],
}


def main() -> None:
    """Write one PNG per scene beside this file."""
    for name, frames in FRAMES.items():
        with tempfile.TemporaryDirectory() as folder:
            wj.simulate(wj.load_scene(HERE.parent / f"{name}.toml"), output=folder)
            render_preview(Path(folder), HERE / f"{name}.png", frames=frames, size=(420, 340))
        print(HERE / f"{name}.png")


if __name__ == "__main__":
    main()
