"""The steps of the demo in the order of the loop, with the texts of its report."""

from foredrive.view.demo_report import Step
from foredrive.view.demo_sections import (
    show_drive,
    show_improvement,
    show_reconstruction,
    show_recording,
    show_search,
    show_shipped,
    show_training,
)

STEPS = (
    Step(
        "Record",
        "recording drives through the embedded towns",
        "Towns grow on CARLA's road maps, with traffic, weather, and sensors whose rays are cast one by one. "
        "Each drive is a 123D log with exact labels, just as a log of your own vehicle would be. Town05 is "
        "held out: nothing below was trained on it.",
        (
            "foredrive record --town Town05 --seconds 30 --rate 2 --seed 1 --out data",
            "foredrive convert pandaset path/to/pandaset --out data",
        ),
        show_recording,
    ),
    Step(
        "See",
        "showing what the shipped model sees in Town05",
        "NeMo is a world model. From six camera images it predicts which voxels are occupied, now and in the "
        "next second, and a plan. This one comes with the package. It learned for thirty minutes in other "
        "towns, from images and lidar without labels, and then to plan as the expert drives.",
        (
            "foredrive evaluate embedded:nemo_town --logs data/logs/town_test --out runs/seen",
            "foredrive view data/logs/town_test/Town05_seed1 --run embedded:nemo_town",
        ),
        show_shipped,
    ),
    Step(
        "Learn",
        "training a tiny model from scratch",
        "The same kind of model, smaller, from random weights: first occupancy and images, then plans. Two "
        "minutes show how it is done, not how good it gets.",
        (
            "foredrive train nemo_tiny --logs data/logs/town_train --out runs/tiny",
            "foredrive evaluate runs/tiny --logs data/logs/town_test",
        ),
        show_training,
    ),
    Step(
        "Drive",
        "driving a route of Town05 in closed loop",
        "The driver that comes with the package has two front cameras, its route and its speed. It reads "
        "the next light, its stop line, and who will be on the route, and chooses a speed. It learned in "
        "other towns. What it sees next depends on what it does. The scores are those of CARLA's "
        "leaderboard 1.0; the expert beside it knows the state of the town.",
        (
            "foredrive drive --agent embedded --routes town05-short --only 12 --out runs/drive",
            "foredrive compare runs/drive runs/expert",
        ),
        show_drive,
    ),
    Step(
        "Reconstruct",
        "reconstructing a drive, and putting a car in the way",
        "A drive becomes 3-D Gaussians: a static part, and one for each moving road user. Cameras and lidar "
        "are rendered from where nobody drove, and a car stands where there was none. Every second frame was "
        "held out of the training.",
        (
            "foredrive reconstruct data/logs/town_test/Town05_seed7 --out runs/reconstructed",
            "foredrive drive --in runs/reconstructed --agent lidar-corridor --threat stationary "
            "--out runs/threat",
            "foredrive view runs/reconstructed",
        ),
        show_reconstruction,
    ),
    Step(
        "Search",
        "searching the recorded drives",
        "Small towers embed every image and every sweep, and texts beside them, so that a moment is found by "
        "words or by example. The hits are a list of clips to train on.",
        (
            "foredrive search index data/logs --index runs/search",
            'foredrive search "a street at night" --index runs/search --clips clips.json',
            "foredrive train nemo_tiny --logs clips.json --out runs/again",
        ),
        show_search,
    ),
    Step(
        "Improve",
        "one round of the loop: failures choose what the driver learns next",
        "The driver drives a training route, and fails. The seconds before each failure are an example of "
        "what it cannot do yet. Moments of an unlabelled pool that resemble them are labelled and learned. "
        "Then it drives again.",
        (
            "foredrive record --town Town01 --virtual-egos 40 --rig front_tele --out pool",
            "foredrive improve embedded --pool pool --rounds 3 --budget 100 --out runs/improved",
        ),
        show_improvement,
    ),
)
