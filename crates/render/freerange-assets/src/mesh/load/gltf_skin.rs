//! Skins of glTF: where joints hold the vertices, in the pose that the nodes are in.

use std::collections::HashMap;
use std::sync::Arc;

use glam::{DAffine3, DMat3, DMat4, DVec3};
use gltf::json::accessor::ComponentType;
use gltf::json::mesh::{Primitive, Semantic};
use gltf::json::validation::Checked;

use super::accessor::{Accessor, Document};
use super::job::Job;
use crate::mesh::error::MeshError;

/// World transforms of a skin's joints, each times its inverse bind matrix.
type Joints = Arc<Vec<DAffine3>>;

/// The skins made so far: many nodes may share a long one.
#[derive(Default)]
pub struct Skins(HashMap<usize, Joints>);

impl Skins {
    /// The joints of a skin. `worlds` has the world transform of each node that the scene reaches.
    pub fn get(
        &mut self,
        job: &Job,
        document: &Document,
        index: usize,
        worlds: &[Option<DAffine3>],
    ) -> Result<Joints, MeshError> {
        if let Some(joints) = self.0.get(&index) {
            return Ok(joints.clone());
        }
        let name = format!("skins[{index}]");
        let skins = &document.root.skins;
        let Some(skin) = skins.get(index) else {
            return Err(job.error(name, format!("an index below {}", skins.len()), index));
        };
        let inverse_binds = match skin.inverse_bind_matrices {
            None => None,
            Some(accessor) => {
                let name = format!("{name}.inverseBindMatrices");
                let accessor = document.accessor(job, &name, accessor)?;
                if accessor.width != 16
                    || accessor.component != ComponentType::F32
                    || accessor.count < skin.joints.len()
                {
                    let found = format!("{} of {} {:?}", accessor.count, accessor.width, accessor.component);
                    return Err(job.error(name, format!("{} matrices of floats", skin.joints.len()), found));
                }
                Some(accessor)
            }
        };
        let mut joints = Vec::with_capacity(skin.joints.len());
        for (i, joint) in skin.joints.iter().enumerate() {
            let Some(world) = worlds.get(joint.value()) else {
                return Err(job.error(
                    format!("{name}.joints"),
                    format!("indices below {}", worlds.len()),
                    joint.value(),
                ));
            };
            let inverse_bind = inverse_binds.as_ref().map_or(DAffine3::IDENTITY, |a| {
                DAffine3::from_mat4(DMat4::from_cols_array(&a.numbers::<16>(i).map(f64::from)))
            });
            joints.push(world.unwrap_or(DAffine3::IDENTITY) * inverse_bind);
        }
        let joints = Arc::new(joints);
        self.0.insert(index, joints.clone());
        Ok(joints)
    }
}

/// What moves the vertices of one primitive.
pub enum Pose<'a> {
    /// All alike.
    Rigid(DAffine3),
    /// Each by up to four joints.
    Skinned { joints: Joints, indices: Accessor<'a>, weights: Accessor<'a> },
}

impl<'a> Pose<'a> {
    /// The pose by `joints`; `None` if the primitive does not say which joints hold it.
    pub fn skinned(
        job: &mut Job,
        document: &'a Document,
        name: &str,
        primitive: &Primitive,
        vertices: usize,
        joints: Joints,
    ) -> Result<Option<Self>, MeshError> {
        let find = |semantic| primitive.attributes.get(&Checked::Valid(semantic)).copied();
        let (Some(indices), Some(weights)) = (find(Semantic::Joints(0)), find(Semantic::Weights(0))) else {
            return Ok(None);
        };
        if find(Semantic::Joints(1)).is_some() {
            job.note("joints after the first four of a vertex are ignored");
        }
        let open = |key: &str, index| {
            let name = format!("{name}.{key}");
            let accessor = document.accessor(job, &name, index)?;
            accessor.expect_kind(job, &name, &[4])?;
            if accessor.count < vertices {
                return Err(job.error(
                    name,
                    format!("as many values as there are positions ({vertices})"),
                    accessor.count,
                ));
            }
            Ok(accessor)
        };
        let (indices, weights) = (open("JOINTS_0", indices)?, open("WEIGHTS_0", weights)?);
        Ok(Some(Self::Skinned { joints, indices, weights }))
    }

    /// World from mesh at vertex `i`.
    pub fn at(&self, job: &Job, name: &str, i: usize) -> Result<DAffine3, MeshError> {
        let (joints, indices, weights) = match self {
            Self::Rigid(world_from_node) => return Ok(*world_from_node),
            Self::Skinned { joints, indices, weights } => (joints, indices, weights),
        };
        let mut weights = weights.numbers::<4>(i).map(|w| if w > 0.0 && w.is_finite() { f64::from(w) } else { 0.0 });
        let sum: f64 = weights.iter().sum();
        if sum == 0.0 {
            weights[0] = 1.0;
        }
        let sum = if sum == 0.0 { 1.0 } else { sum };
        let (mut linear, mut offset) = (DMat3::ZERO, DVec3::ZERO);
        for (joint, weight) in indices.numbers::<4>(i).into_iter().zip(weights) {
            if weight == 0.0 {
                continue;
            }
            let Some(m) = joints.get(joint.max(0.0) as usize) else {
                return Err(job.error(format!("{name}.JOINTS_0"), format!("indices below {}", joints.len()), joint));
            };
            linear += m.matrix3 * (weight / sum);
            offset += m.translation * (weight / sum);
        }
        Ok(DAffine3::from_mat3_translation(linear, offset))
    }
}
