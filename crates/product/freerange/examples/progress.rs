//! Progress with a preview, cancellation, errors by kind, and a camera of one's own:
//! `cargo run --release -p freerange --example progress -- examples/bowl picture.png`

use std::{ops::ControlFlow, path::Path, time::Instant};

use freerange::{
    Choices, Device, Error, Options, Quality, Reconstructor, Scene, glam::DVec3, image::RgbaImage,
    pictures::render_view,
};

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [scene, picture] = &arguments[..] else { return eprintln!("expected SCENE and PICTURE.png") };
    match draft(Path::new(scene)) {
        Ok(image) => image.save(picture).unwrap_or_else(|e| eprintln!("{picture}: {e}")),
        Err(Error::Cancelled) => eprintln!("took longer than a minute"),
        Err(Error::Io { path, cause }) => eprintln!("look at {}: {cause}", path.display()),
        Err(other) => eprintln!("{other}"),
    }
}

fn draft(scene: &Path) -> Result<RgbaImage, Error> {
    let (begin, scene) = (Instant::now(), Scene::open(scene)?);
    let model = Reconstructor::shipped(&Device::open("auto")?)?;
    let mut options: Options = model.options_of(&Choices { quality: Quality::Draft, ..Choices::default() })?;
    options.frame = scene.frame;
    let result = model.run(scene.views(), &options, &mut |progress| {
        if progress.done.is_multiple_of(50)
            && let Ok(Some(preview)) = progress.preview()
        {
            eprintln!("{} {} of {}: {} Gaussians", progress.stage, progress.done, progress.total, preview.len());
        }
        if begin.elapsed().as_secs() < 60 { ControlFlow::Continue(()) } else { ControlFlow::Break(()) }
    })?;
    // From above the first camera, at the object's middle.
    let (first, place) = (scene.views()[0].camera, result.canonical_from_user.inverse());
    let (up, middle) = (result.up(), place.apply(DVec3::ZERO));
    let eye = first.center() + 0.5 * place.scale * up;
    let camera = freerange::Camera::look_at(eye, middle, up, 45f64.to_radians(), 512, 512);
    let rgb = render_view(&result.samples[0].gaussians, &camera)?;
    let byte = |v: f32| (255.0 * v.clamp(0.0, 1.0)).round() as u8;
    Ok(RgbaImage::from_fn(512, 512, |x, y| {
        let at = 3 * (y * 512 + x) as usize;
        freerange::image::Rgba([byte(rgb[at]), byte(rgb[at + 1]), byte(rgb[at + 2]), 255])
    }))
}
