"""Runs one stage of pycolmap, for `densify poses`: python engine.py STAGE REQUEST.json

Each line on standard output that begins with "progress " reports a count: progress WHAT DONE TOTAL.
Results are files in the request's folder; densify reads them and decides what happens next.
"""

import json
import math
import os
import sys
import threading


def progress(what, done, total):
    print(f"progress {what} {done} {total}", flush=True)


def end_with_parent():
    """Ends this process when densify has ended, however it did: its end of the standard input then closes."""
    while os.read(0, 1024):
        pass
    os._exit(1)


def every(count, total):
    """At most fifty reports for a loop, and one for its end."""
    return count == total or count % max(1, total // 50) == 0


def features(pycolmap, ask):
    """Finds keypoints in all photographs that the database lacks, a few at a time so that progress shows."""
    reader = pycolmap.ImageReaderOptions()
    reader.camera_model = ask["camera_model"]
    if ask.get("masks"):
        reader.mask_path = ask["masks"]
    options = pycolmap.FeatureExtractionOptions()
    options.num_threads = ask["threads"]
    options.use_gpu = False
    options.max_image_size = ask["max_image_size"]
    options.sift.peak_threshold = ask["peak_threshold"]
    names = ask["names"]
    step = max(ask["threads"], 4)
    done = 0
    for group in ask["groups"]:
        for first in range(0, len(group), step):
            # One camera per group: the first photographs make it, also in an earlier call.
            known = cameras(pycolmap, ask["database"])
            shared = [known[name] for name in group if name in known]
            reader.existing_camera_id = shared[0] if shared else -1
            part = group[first : first + step] if shared else group[first : first + 1]
            if not shared:
                extract(pycolmap, ask, part, reader, options)
                known = cameras(pycolmap, ask["database"])
                reader.existing_camera_id = known.get(part[0], -1)
                part = group[first + 1 : first + step]
            if part:
                extract(pycolmap, ask, part, reader, options)
            done += len(group[first : first + step])
            progress("features", done, len(names))
    with pycolmap.Database.open(ask["database"]) as database:
        counts = {image.name: database.num_keypoints_for_image(image.image_id) for image in database.read_all_images()}
    return {"keypoints": [counts.get(name, 0) for name in names]}


def cameras(pycolmap, path):
    """The camera of each photograph in the database."""
    with pycolmap.Database.open(path) as database:
        return {image.name: image.camera_id for image in database.read_all_images()}


def extract(pycolmap, ask, names, reader, options):
    pycolmap.extract_features(
        ask["database"], ask["images"], image_names=names, camera_mode=pycolmap.CameraMode.SINGLE,
        reader_options=reader, extraction_options=options, device=pycolmap.Device.cpu,
    )


def pairs(pycolmap, ask):
    """Matches pairs of photographs, and hands over what two-view geometry says about each."""
    matching = pycolmap.FeatureMatchingOptions()
    matching.num_threads = ask["threads"]
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = ask["seed"]
    with pycolmap.Database.open(ask["database"]) as database:
        ids = {image.name: image.image_id for image in database.read_all_images()}
    names = [name for name in ask["names"] if name in ids]
    wanted = [(names[first], names[second]) for first, second in chosen_pairs(len(names), ask["window"])]
    listing = os.path.join(ask["folder"], "wanted_pairs.txt")
    step = 400
    for first in range(0, len(wanted), step):
        with open(listing, "w", encoding="utf-8") as out:
            out.writelines(f"{a} {b}\n" for a, b in wanted[first : first + step])
        options = pycolmap.ImportedPairingOptions()
        options.match_list_path = listing
        pycolmap.match_image_pairs(
            ask["database"], matching_options=matching, pairing_options=options,
            verification_options=verification, device=pycolmap.Device.cpu,
        )
        progress("pairs", min(first + step, len(wanted)), len(wanted))
    return {}


def chosen_pairs(count, window):
    """All pairs if the window is 0. Otherwise neighbours, neighbours at powers of two, and every tenth with every tenth."""
    if window == 0:
        return [(a, b) for a in range(count) for b in range(a + 1, count)]
    gaps = set(range(1, window + 1))
    while max(gaps) * 2 < count:
        gaps.add(max(gaps) * 2)
    near = {(a, a + gap) for a in range(count) for gap in gaps if a + gap < count}
    spread = range(0, count, 10)
    return sorted(near | {(a, b) for a in spread for b in spread if a < b})


def polish(pycolmap, model):
    """Adjusts all cameras and points once more with a loss that hardly counts outliers, which the mappers do not.

    Views and points of table and layers (60 views of 480x360 px) then lie half as far from the truth.
    """
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = False
    options.print_summary = False
    options.ceres.use_gpu = False
    options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    options.ceres.loss_function_scale = 1.0
    options.ceres.solver_options.max_num_iterations = 200
    pycolmap.bundle_adjustment(model, options)


def evidence(pycolmap, ask, model):
    """What matches say about pairs of a model's photographs, seen through its cameras: inliers, kind and rotation.

    The rotations that matching found rest on guessed focal lengths and are mostly wrong, so they are estimated again.
    """
    options = pycolmap.TwoViewGeometryOptions()
    options.compute_relative_pose = True
    options.ransac.random_seed = ask["seed"]
    found = []
    with pycolmap.Database.open(ask["database"]) as database:
        images = {image.image_id: image for image in database.read_all_images() if model.exists_image(image.image_id)}
        images = {key: image for key, image in images.items() if model.images[key].has_pose}
        keypoints = {key: database.read_keypoints(key)[:, :2].astype(float) for key in images}
        for identifier, geometry in zip(*database.read_two_view_geometries()):
            first, second = pycolmap.pair_id_to_image_pair(identifier)
            if first not in images or second not in images or len(geometry.inlier_matches) == 0:
                continue
            cameras = [model.cameras[model.images[key].camera_id] for key in (first, second)]
            again = pycolmap.estimate_calibrated_two_view_geometry(
                cameras[0], keypoints[first], cameras[1], keypoints[second], geometry.inlier_matches, options
            )
            pose = again.cam2_from_cam1
            kind = pycolmap.TwoViewGeometryConfiguration(again.config).name
            if pose is None or kind == "UNCALIBRATED":
                continue
            x, y, z, w = (float(value) for value in pose.rotation.quat)
            found.append({
                "first": images[first].name, "second": images[second].name,
                "inliers": len(again.inlier_matches), "rotation": [w, x, y, z],
                # Homographies of planes leave the direction uncertain.
                "translation": [float(value) for value in pose.translation] if kind == "CALIBRATED" else None,
                "parallax": math.degrees(again.tri_angle),
            })
    return found


def mapping(pycolmap, ask):
    """Computes models and writes each into a numbered folder."""
    os.makedirs(ask["models"], exist_ok=True)
    total = len(ask["names"])
    if ask["mapper"] == "global":
        options = pycolmap.GlobalPipelineOptions()
        options.num_threads = ask["threads"]
        options.random_seed = ask["seed"]
        options.mapper.num_threads = ask["threads"]
        options.mapper.random_seed = ask["seed"]
        options.mapper.rotation_averaging.random_seed = ask["seed"]
        options.mapper.global_positioning.random_seed = ask["seed"]
        options.mapper.global_positioning.use_gpu = False
        options.mapper.bundle_adjustment.ceres.use_gpu = False
        options.mapper.retriangulation.random_seed = ask["seed"]
        found = pycolmap.global_mapping(ask["database"], ask["images"], ask["models"], options=options)
    else:
        options = pycolmap.IncrementalPipelineOptions()
        options.num_threads = ask["threads"]
        options.random_seed = ask["seed"]
        options.mapper.num_threads = ask["threads"]
        options.mapper.random_seed = ask["seed"]
        options.triangulation.random_seed = ask["seed"]
        options.min_model_size = ask["min_model_size"]
        if ask["mapper"] == "relaxed":
            options.mapper.init_min_num_inliers = 50
            options.mapper.abs_pose_min_num_inliers = 15
            options.mapper.init_min_tri_angle = 8.0
        placed = [0]

        def next_image():
            placed[0] += 1
            if every(placed[0], total):
                progress("placed", min(placed[0], total), total)

        found = pycolmap.incremental_mapping(
            ask["database"], ask["images"], ask["models"], options=options, next_image_callback=next_image
        )
    for number, model in found.items():
        folder = os.path.join(ask["models"], str(number))
        os.makedirs(folder, exist_ok=True)
        polish(pycolmap, model)
        model.write(folder)
        write(os.path.join(folder, "pairs.json"), evidence(pycolmap, ask, model))
        progress("polished", number + 1, len(found))
    return {"models": sorted(found)}


def write(path, result):
    """Writes a file that is complete or absent."""
    with open(path + ".partial", "w", encoding="utf-8") as out:
        json.dump(result, out)
    os.replace(path + ".partial", path)


STAGES = {"features": features, "pairs": pairs, "mapping": mapping}


def main():
    import pycolmap

    stage = sys.argv[1]
    threading.Thread(target=end_with_parent, daemon=True).start()
    with open(sys.argv[2], encoding="utf-8") as file:
        ask = json.load(file)
    pycolmap.set_random_seed(ask["seed"])
    write(ask["result"], STAGES[stage](pycolmap, ask))


if __name__ == "__main__":
    main()
