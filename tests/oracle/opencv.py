"""OpenCV's poses of the rooms that `cargo xtask oracle` simulated, beside ours, as a table.

Reads the JSON file named first and writes the table's figures to the one named second. OpenCV gets the same angles as normalised image points of a camera of 1000 pixels focal
length: solvePnPRansac believes points within three standard deviations, solvePnPRefineLM refines on its inliers.
"""

import json
import sys

import cv2
import numpy as np

FOCAL_PX = 1000.0
RANSAC_ITERATIONS = 1000
FAILED_DEG = 1.0
# By how much the ratio of the two medians (rotation, position, angles) may be above 1 by the draw of the rooms alone, times
# the root of the number of stations: two standard deviations, found by drawing 40 stations again and again. At 2,000
# stations that is 2.5, 4.0 and 0.9 %.
CHANCE = np.array([1.1, 1.8, 0.42])


def opencv(places, angles, noise_rad):
    image = np.tan(angles) * FOCAL_PX
    camera = np.array([[FOCAL_PX, 0, 0], [0, FOCAL_PX, 0], [0, 0, 1.0]])
    # A pixel is a thousandth of a radian at the centre and less beside it.
    reach = 3 * noise_rad * FOCAL_PX * np.sqrt(2) * np.median(1 + np.tan(angles) ** 2)
    found, turn, shift, inliers = cv2.solvePnPRansac(
        places, image, camera, None, iterationsCount=RANSAC_ITERATIONS, reprojectionError=reach, confidence=0.9999
    )
    if not found or inliers is None or len(inliers) < 6:
        return None
    inliers = inliers.ravel()
    turn, shift = cv2.solvePnPRefineLM(places[inliers], image[inliers], camera, None, turn, shift)
    rotation, _ = cv2.Rodrigues(turn)
    return rotation, (-rotation.T @ shift).ravel()


def seen(rotation, position, places):
    c = (places - position) @ rotation.T
    return np.arctan2(c[:, :2], c[:, 2:])


def errors(pose, truth, places):
    if pose is None:
        return None
    (rotation, position), (true_rotation, true_position) = pose, truth
    cosine = (np.trace(rotation @ true_rotation.T) - 1) / 2
    turned = np.degrees(np.arccos(np.clip(cosine, -1, 1)))
    moved = 100 * np.linalg.norm(position - true_position)
    missed = seen(rotation, position, places) - seen(true_rotation, true_position, places)
    return turned, moved, np.degrees(np.sqrt(np.mean(np.sum(missed**2, axis=1))))


def main():
    with open(sys.argv[1], encoding="utf-8") as file:
        simulated = json.load(file)
    results = {"this solver": [], "OpenCV": []}
    for room in simulated["rooms"]:
        places = np.array(room["places"])
        for station in room["stations"]:
            pose = lambda p: None if p is None else (np.array(p["rotation"]), np.array(p["position"]))
            truth = pose(station["true"])
            results["this solver"].append(errors(pose(station["solved"]), truth, places))
            theirs = opencv(places, np.array(station["angles"]), simulated["noise_rad"])
            results["OpenCV"].append(errors(theirs, truth, places))
    stations = len(results["OpenCV"])
    print(f"{len(simulated['rooms'])} rooms, {stations} stations; OpenCV {cv2.__version__}")
    print("| | rotation, deg: median | p95 | position, cm: median | p95 | angles, deg RMS: median | p95 | failed |")
    print("|---|---|---|---|---|---|---|---|")
    medians = {}
    fails = {}
    summary = {"rooms": len(simulated["rooms"]), "stations": stations, "opencv": cv2.__version__}
    for name, rows in results.items():
        good = np.array([row for row in rows if row is not None])
        quantiles = [float(q) for k in range(3) for q in np.quantile(good[:, k], [0.5, 0.95])]
        figures = " | ".join(f"{q:.3f}" for q in quantiles)
        failed = sum(row is None or row[2] > FAILED_DEG for row in rows)
        print(f"| {name} | {figures} | {failed} |")
        medians[name] = np.median(good, axis=0)
        fails[name] = failed
        summary[name] = {"rotation_position_angles": quantiles, "failed": int(failed)}
    with open(sys.argv[2], "w", encoding="utf-8") as file:
        json.dump(summary, file, indent=2)
    ours, theirs = "this solver", "OpenCV"
    worse = medians[ours] / medians[theirs]
    print(f"medians beside OpenCV's: {worse.round(3)}, may be {(1 + CHANCE / np.sqrt(stations)).round(3)}")
    if not np.all(worse <= 1 + CHANCE / np.sqrt(stations)) or fails[ours] > fails[theirs]:
        sys.exit("this solver is worse than OpenCV's")


main()
