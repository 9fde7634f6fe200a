"""Poses of photos by pycolmap, run by `freerange poses` in a Python that has it.

usage: engine.py JOB.json
JOB: work, images (folders), names, groups (lists of names that share a camera), pairs (a file), thorough, all_pairs, threads (a number or null), masks (a folder or null), seed.
Prints a line of JSON for each step that begins; the model comes into work/model, what was done into work/result.json.
"""
import json
import pathlib
import sys

import pycolmap


def say(**what):
    print(json.dumps(what), flush=True)


def main():
    job = json.loads(pathlib.Path(sys.argv[1]).read_text(encoding="utf-8"))
    work = pathlib.Path(job["work"])
    pycolmap.logging.minloglevel = 2
    pycolmap.set_random_seed(job["seed"])
    database = work / "database.db"

    reader = pycolmap.ImageReaderOptions(camera_model="SIMPLE_RADIAL")
    if job["masks"]:
        reader.mask_path = job["masks"]
    extraction = pycolmap.FeatureExtractionOptions(use_gpu=False)
    extraction.sift.max_num_features = 16384
    extraction.sift.peak_threshold = job["peak_threshold"]
    extraction.sift.estimate_affine_shape = job["thorough"]
    extraction.sift.domain_size_pooling = job["thorough"]
    if job["threads"]:
        extraction.num_threads = job["threads"]
    for i, names in enumerate(job["groups"]):
        say(step="features", done=i, total=len(job["groups"]))
        pycolmap.extract_features(
            database, job["images"], image_names=names, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader,
            extraction_options=extraction, device=pycolmap.Device.cpu)

    matching = pycolmap.FeatureMatchingOptions(use_gpu=False, guided_matching=job["thorough"])
    geometry = pycolmap.TwoViewGeometryOptions(filter_stationary_matches=True)
    mapper = pycolmap.IncrementalPipelineOptions(
        min_model_size=3, num_threads=1, random_seed=job["seed"], ba_use_gpu=False, extract_colors=True)
    mapper.max_runtime_seconds = 600
    mapper.mapper.abs_pose_min_num_inliers = 15
    mapper.mapper.init_min_tri_angle = 4.0
    mapper.mapper.init_min_num_inliers = 30
    mapper.triangulation.ignore_two_view_tracks = False

    best, models, used = None, [], None
    for stage in ("neighbors", "all") if job["all_pairs"] else ("neighbors",):
        say(step="matches", pairs=stage)
        if stage == "neighbors":
            pairs = pycolmap.ImportedPairingOptions(match_list_path=job["pairs"])
            pycolmap.match_image_pairs(
                database, matching_options=matching, pairing_options=pairs, verification_options=geometry, device=pycolmap.Device.cpu)
        else:
            pycolmap.match_exhaustive(
                database, matching_options=matching, verification_options=geometry, device=pycolmap.Device.cpu)
        say(step="model", pairs=stage)
        out = work / f"models-{stage}"
        out.mkdir(exist_ok=True)
        found = sorted(pycolmap.incremental_mapping(database, job["images"], out, mapper).values(), key=lambda r: -r.num_reg_images())
        if found and (best is None or found[0].num_reg_images() > best.num_reg_images()):
            best, models, used = found[0], [r.num_reg_images() for r in found], stage
        if best is not None and best.num_reg_images() == len(job["names"]):
            break
    model = work / "model"
    model.mkdir(exist_ok=True)
    result = {"engine": f"pycolmap {pycolmap.__version__}", "models": models, "pairs": used, "points": 0}
    if best is not None:
        best.write_binary(model)
        result["points"] = best.num_points3D()
        result["reprojection_error"] = best.compute_mean_reprojection_error()
    (work / "result.json").write_text(json.dumps(result), encoding="utf-8")


main()
