//! Textures: charts laid out in a picture, colors at their texels.

use glam::{DVec2, Vec2, Vec3};
use image::{Rgb, RgbImage};
use rayon::prelude::*;
use uvunwrap::{Density, MeshInput, Options, generate};

use crate::meshing::{Baked, Shape, SurfaceError};

/// Texels around each chart, which take the colors of its border.
const PADDING: u32 = 2;
/// Texels this far beyond an edge, as a share of the triangle, are inside.
const SLACK: f64 = 1e-9;

/// A mesh with a texture `size` texels wide and at most as high, whose texels have the color of the place and unit normal
/// that they show. Vertices are doubled where charts end.
///
/// # Errors
/// [`SurfaceError::Setting`] where the charts need more texels; [`SurfaceError::Atlas`].
pub(crate) fn bake(
    shape: Shape,
    size: usize,
    color: impl Fn(Vec3, Vec3) -> Vec3 + Sync,
) -> Result<Shape, SurfaceError> {
    let positions: Vec<[f32; 3]> = shape.positions.iter().map(|p| p.to_array()).collect();
    let indices: Vec<u32> = shape.triangles.iter().flatten().copied().collect();
    let options = Options { density: Density::Auto { page_size: size as u32 }, padding: PADDING, ..Options::default() };
    let mut atlas = generate(&[MeshInput::new(&positions, &indices)], &options)?;
    let (Some(mesh), 1) = (atlas.meshes.pop(), atlas.page_count) else {
        let expected = format!("enough texels for {} charts", atlas.chart_count).into();
        return Err(SurfaceError::Setting { setting: "texture", expected, found: size });
    };
    let pick = |values: &[Vec3]| mesh.vertices.iter().map(|v| values[v.xref as usize]).collect();
    let uvs: Vec<Vec2> = mesh.vertices.iter().map(|v| Vec2::from_array(v.uv)).collect();
    let shape = Shape {
        positions: pick(&shape.positions),
        normals: pick(&shape.normals),
        colors: Vec::new(),
        triangles: mesh.indices.as_chunks::<3>().0.to_vec(),
        ..shape
    };
    let image = picture(&shape, &uvs, [atlas.width, atlas.height], color);
    Ok(Shape { texture: Some(Baked { uvs, image }), ..shape })
}

/// No triangle at a texel.
const NOTHING: u32 = u32::MAX;

fn picture(shape: &Shape, uvs: &[Vec2], size: [u32; 2], color: impl Fn(Vec3, Vec3) -> Vec3 + Sync) -> RgbImage {
    let [width, height] = size.map(|v| v as usize);
    let scale = DVec2::new(width as f64, height as f64);
    let corners = |triangle: usize| shape.triangles[triangle].map(|v| scale * uvs[v as usize].as_dvec2());
    // Which triangle a texel's middle lies in.
    let mut owners = vec![NOTHING; width * height];
    for i in 0..shape.triangles.len() {
        let at = corners(i);
        let (low, high) = (at[0].min(at[1]).min(at[2]), at[0].max(at[1]).max(at[2]));
        for y in low.y as usize..(high.y.ceil() as usize).min(height) {
            for x in low.x as usize..(high.x.ceil() as usize).min(width) {
                if weights(at, DVec2::new(x as f64 + 0.5, y as f64 + 0.5)).is_some() {
                    owners[y * width + x] = i as u32;
                }
            }
        }
    }
    let shown = |(texel, owner): (usize, &u32)| {
        let triangle = (*owner != NOTHING).then_some(*owner as usize)?;
        let at = DVec2::new((texel % width) as f64 + 0.5, (texel / width) as f64 + 0.5);
        let weights = weights(corners(triangle), at)?.map(|w| w as f32);
        let mean = |values: &[Vec3]| -> Vec3 {
            shape.triangles[triangle].iter().zip(weights).map(|(v, w)| w * values[*v as usize]).sum()
        };
        Some(color(mean(&shape.positions), mean(&shape.normals).normalize_or(Vec3::Z)))
    };
    let mut texels: Vec<Option<Vec3>> = owners.par_iter().enumerate().map(shown).collect();
    // One more, as a chart's border runs across texels whose middles lie outside.
    for _ in 0..=PADDING {
        texels = grown(&texels, width);
    }
    let (sum, count) = texels.iter().flatten().fold((Vec3::ZERO, 0u32), |(s, n), c| (s + *c, n + 1));
    // What nothing shows goes into smaller copies only.
    let other = sum / count.max(1) as f32;
    RgbImage::from_fn(size[0], size[1], |x, y| {
        let color = texels[y as usize * width + x as usize].unwrap_or(other);
        Rgb((255.0 * color).to_array().map(|v| v.round() as u8))
    })
}

/// The weights of a triangle's corners at a point in it.
fn weights([a, b, c]: [DVec2; 3], at: DVec2) -> Option<[f64; 3]> {
    let area = (b - a).perp_dot(c - a);
    let weights = [(b - at).perp_dot(c - at), (c - at).perp_dot(a - at), (a - at).perp_dot(b - at)].map(|w| w / area);
    weights.iter().all(|w| *w >= -SLACK).then_some(weights)
}

/// Texels without a color take the mean of their neighbors'.
fn grown(texels: &[Option<Vec3>], width: usize) -> Vec<Option<Vec3>> {
    let height = texels.len() / width;
    let grow = |i: usize| {
        if texels[i].is_some() {
            return texels[i];
        }
        let (x, y) = (i % width, i / width);
        let (columns, rows) = (x.saturating_sub(1)..(x + 2).min(width), y.saturating_sub(1)..(y + 2).min(height));
        let near = rows.flat_map(|y| columns.clone().map(move |x| y * width + x)).filter_map(|j| texels[j]);
        let (sum, count) = near.fold((Vec3::ZERO, 0u32), |(s, n), c| (s + c, n + 1));
        (count > 0).then(|| sum / count as f32)
    };
    (0..texels.len()).into_par_iter().map(grow).collect()
}
