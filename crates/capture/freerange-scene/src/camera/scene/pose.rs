//! A frame's `transform_matrix`: checked, cleaned, and turned to OpenCV's axes.

use crate::camera::{CameraError, error::Place};
use glam::{DMat3, DMat4, DVec3};

/// Largest accepted departure of `R^T R` from the identity: files often hold only four digits.
const ORTHONORMAL_TOLERANCE: f64 = 1e-3;
/// Largest accepted coordinate of a camera: beyond it 64 bits do not resolve a ten-millionth of a unit. (Maps end at 2e7 meters.)
pub const LARGEST_COORDINATE: f64 = 1e9;

/// The world-to-camera transform with OpenCV axes (x right, y down, z forward) of a camera-to-world matrix with
/// OpenGL axes (x right, y up, z backward), given row by row: 3 or 4 rows of 4.
pub fn world_to_camera(rows: &[[f64; 4]], place: &Place) -> Result<DMat4, CameraError> {
    let refuse = |found: String| Err(CameraError::NotRigid { place: place.clone(), found });
    if let Some(last) = rows.get(3) {
        let expected = [0.0, 0.0, 0.0, 1.0];
        if last.iter().zip(expected).any(|(v, e)| (v - e).abs() > 1e-6) {
            return refuse(format!("a last row of {last:?}, not [0, 0, 0, 1]"));
        }
    }
    let column = |j: usize| DVec3::new(rows[0][j], rows[1][j], rows[2][j]);
    let (rotation, center) = (DMat3::from_cols(column(0), column(1), column(2)), column(3));
    if center.abs().max_element() > LARGEST_COORDINATE {
        return refuse(format!("a camera at {center}, farther than {LARGEST_COORDINATE} from the origin"));
    }
    let rotation = match nearest_rotation(rotation) {
        Ok(r) => r,
        Err(found) => return refuse(found),
    };
    let world_from_camera = rotation * DMat3::from_diagonal(DVec3::new(1.0, -1.0, -1.0));
    let camera_from_world = world_from_camera.transpose();
    let translation = -(camera_from_world * center);
    Ok(DMat4::from_cols(
        camera_from_world.x_axis.extend(0.0),
        camera_from_world.y_axis.extend(0.0),
        camera_from_world.z_axis.extend(0.0),
        translation.extend(1.0),
    ))
}

/// The rotation nearest to a matrix that is one up to rounding; otherwise what the matrix is instead.
pub fn nearest_rotation(m: DMat3) -> Result<DMat3, String> {
    let gram = m.transpose() * m;
    let largest = |m: DMat3| m.to_cols_array().iter().fold(0.0f64, |a, v| a.max(v.abs()));
    let scale_squared = (gram.x_axis.x + gram.y_axis.y + gram.z_axis.z) / 3.0;
    let orthonormal = largest(gram - DMat3::IDENTITY) <= ORTHONORMAL_TOLERANCE;
    if !orthonormal {
        if scale_squared < 1e-12 {
            return Err("a zero matrix".into());
        }
        let similar = largest(gram * (1.0 / scale_squared) - DMat3::IDENTITY) <= ORTHONORMAL_TOLERANCE;
        return Err(match similar {
            true => format!("a uniform scale of {:.6}; divide the 3 x 3 part by it", scale_squared.sqrt()),
            false => "axes that are not of unit length and at right angles (shear or unequal scale)".into(),
        });
    }
    if m.determinant() < 0.0 {
        return Err("a mirrored coordinate system (determinant -1)".into());
    }
    // Newton's iteration for the polar factor; quadratic, so three steps from 1e-3 reach rounding.
    let step = |r: DMat3| r * (DMat3::IDENTITY * 1.5 - (r.transpose() * r) * 0.5);
    Ok(step(step(step(m))))
}
