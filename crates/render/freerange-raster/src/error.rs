//! Why Gaussians cannot be rendered.

/// Why an image could not be rendered.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum RasterError {
    /// An argument has the wrong number of elements.
    #[error("`{field}` has {found} elements, expected {expected}")]
    Length {
        /// Which argument.
        field: &'static str,
        /// Elements it should have.
        expected: usize,
        /// Elements it has.
        found: usize,
    },
    /// The Gaussians have the wrong shape.
    #[error("the Gaussians have shape {found:?}, expected [objects, n, 14] with {objects} objects")]
    Shape {
        /// Objects, by the number of camera lists.
        objects: usize,
        /// The tensor's shape.
        found: [usize; 3],
    },
    /// The Gaussians are not float32.
    #[error("the Gaussians have the data type {found}, expected F32")]
    DataType {
        /// The tensor's data type.
        found: String,
    },
    /// An image is empty, too large, or differs in size from that of the first view.
    #[error(
        "view {view} is {found:?} pixels (width, height), expected {expected:?} as in view 0, between 1 and {limit}"
    )]
    ImageSize {
        /// Which view.
        view: usize,
        /// Width and height of the first view.
        expected: [u32; 2],
        /// Width and height.
        found: [u32; 2],
        /// Largest width and height.
        limit: u32,
    },
    /// A camera's numbers are not finite, or a focal length is not positive.
    #[error("the camera of view {view} is not finite, or has a focal length that is not positive")]
    Camera {
        /// Which view.
        view: usize,
    },
    /// A background color is not finite.
    #[error("the background of view {view} is not finite")]
    Background {
        /// Which view.
        view: usize,
    },
    /// The settings make no sense.
    #[error("expected 0 < near <= far and a finite blur >= 0, found near {near}, far {far}, blur {blur}")]
    Config {
        /// Nearest camera z.
        near: f32,
        /// Farthest camera z.
        far: f32,
        /// Variance added in the image.
        blur: f32,
    },
}
