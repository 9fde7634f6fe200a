//! Which values are refused, in the order in which they are looked at.

use freerange_data::Making;
use freerange_diffusion::{coupling::Coupling, sample::RefinerConfig};
use freerange_model::ModelKind;
use freerange_util::{Invalid, ensure};

use super::{LossConfig, RefinementLoss, Stage, TrainConfig};
use crate::TrainError;

impl<M: Making> TrainConfig<M> {
    /// Refuses impossible values.
    pub fn validate(&self) -> Result<(), TrainError> {
        self.model.validate()?;
        self.sample.validate().map_err(|e| e.within("sample"))?;
        let refiner = self.refiner.as_ref().map_or(Ok(()), RefinerConfig::validate);
        refiner.map_err(|e| e.within("refiner"))?;
        ensure(!self.stages.is_empty(), "stage", "at least one [[stage]]", "none")?;
        self.data.making.check(self.seed, &self.depths())?;
        self.stages.iter().try_for_each(|s| self.check_stage(s))?;
        let v = &self.validation;
        ensure((1..=10_000).contains(&v.objects), "validation.objects", "1 to 10000", v.objects)?;
        self.check_views()?;
        self.loss.check_terms(self.model.estimate_channels)?;
        self.loss.refinement.map_or(Ok(()), |refinement| self.check_refinement(refinement))?;
        self.loss.check_numbers()?;
        self.validate_kind()?;
        self.optimizer.validate()?;
        self.check_data()?;
        self.check_tokens()?;
        Ok(())
    }

    fn check_stage(&self, s: &Stage) -> Result<(), Invalid> {
        ensure((1..=20).contains(&s.depth), "stage.depth", "1 to 20", s.depth)?;
        ensure(s.batch > 0, "stage.batch", "at least 1", s.batch)?;
        ensure(
            (1..=s.batch).contains(&s.at_a_time()),
            "stage.micro_batch",
            &format!("1 to {} (stage.batch)", s.batch),
            s.at_a_time(),
        )?;
        for (field, size) in [("stage.render_size", s.render_size), ("stage.gradient_size", s.gradient_size)] {
            ensure(size.is_none_or(|s| (8..=4096).contains(&s)), field, "8 to 4096", format!("{size:?}"))?;
        }
        ensure(s.steps > 0, "stage.steps", "at least 1", s.steps)?;
        ensure((8..=2048).contains(&s.image_size), "stage.image_size", "8 to 2048", s.image_size)?;
        let patch = self.model.encoder.patch_size();
        ensure(
            s.image_size.is_multiple_of(patch),
            "stage.image_size",
            &format!("a multiple of the encoder's patch, {patch}"),
            s.image_size,
        )
    }

    /// That objects have the views that batches take of them.
    fn check_views(&self) -> Result<(), Invalid> {
        let l = &self.loss;
        let (low, high) = l.input_views;
        let views = self.data.making.views();
        ensure(low >= 1 && low <= high, "loss.input_views", "[fewest, most], at least 1", format!("[{low}, {high}]"))?;
        ensure(
            views >= high + l.held_views,
            "data.object.views",
            &format!("at least {} (loss.input_views + loss.held_views)", high + l.held_views),
            views,
        )
    }

    fn check_refinement(&self, loss: RefinementLoss) -> Result<(), Invalid> {
        let RefinementLoss { share, render_weight } = loss;
        ensure((0.0..=1.0).contains(&share), "loss.refinement.share", "0 to 1", share)?;
        ensure(
            render_weight.is_finite() && render_weight >= 0.0,
            "loss.refinement.render_weight",
            "a finite number, 0 or more",
            render_weight,
        )?;
        ensure(
            !self.loss.random_patches,
            "loss.random_patches",
            "false with loss.refinement, whose fits are in the tree's order",
            "true",
        )?;
        let made = self.data.shards.is_some() || self.data.making.input_fits() > 0;
        ensure(made, "data.object.input_fits", "at least 1 with loss.refinement", "0")
    }

    /// That virtual ranks divide what they share, and that there is anything.
    fn check_data(&self) -> Result<(), Invalid> {
        let virtual_ranks = self.data.virtual_ranks;
        ensure((1..=4096).contains(&virtual_ranks), "data.virtual_ranks", "1 to 4096", virtual_ranks)?;
        let of_ranks = format!("a multiple of data.virtual_ranks, {virtual_ranks}");
        for (field, value) in [("data.window", self.data.window), ("data.fresh", self.data.fresh)] {
            ensure(value.is_multiple_of(virtual_ranks), field, &of_ranks, value)?;
        }
        for s in &self.stages {
            ensure(s.batch.is_multiple_of(virtual_ranks), "stage.batch", &of_ranks, s.batch)?;
        }
        ensure(self.data.window > 0, "data.window", "at least 1", self.data.window)?;
        ensure(self.data.workers > 0, "data.workers", "at least 1", self.data.workers)?;
        ensure(self.data.statistics_objects > 0, "data.statistics_objects", "at least 1", "0")
    }

    /// That a token fits into every depth.
    fn check_tokens(&self) -> Result<(), Invalid> {
        let p = self.model.gaussians_per_token;
        for s in &self.stages {
            ensure((1usize << s.depth) >= p, "stage.depth", "at least one token", s.depth)?;
        }
        let refined = self.refiner.as_ref().and_then(|r| r.lod_depth);
        for (field, depth) in [("sample.lod_depth", self.sample.lod_depth), ("refiner.lod_depth", refined)] {
            if let Some(depth) = depth {
                ensure((1usize << depth) >= p, field, "at least one token", depth)?;
            }
        }
        Ok(())
    }

    /// Refuses losses and sampling that a model of this kind does not have.
    fn validate_kind(&self) -> Result<(), TrainError> {
        let (kind, l) = (self.model.kind, &self.loss);
        self.sample.validate_for(kind, &self.sample).map_err(|e| e.within("sample"))?;
        if !kind.one_pass() {
            return Ok(());
        }
        let check = |ok: bool, field: &str, expected: &str, found: String| {
            let expected = format!("{expected} for a {} model, which predicts in one pass", kind.name());
            ensure(ok, field, &expected, found)
        };
        check(!l.flow, "loss.flow", "false", "true".into())?;
        check(l.seen || (l.held && l.held_views > 0), "loss", "a rendering loss", "none".into())?;
        check(l.unconditional == 0.0, "loss.unconditional", "0", l.unconditional.to_string())?;
        check(!l.random_patches, "loss.random_patches", "false", "true".into())?;
        check(l.coupling == Coupling::Independent, "loss.coupling", "independent", "tree".into())?;
        check(l.refinement.is_none(), "loss.refinement", "none", "one".into())?;
        check(self.refiner.is_none(), "refiner", "none", "one".into())?;
        if kind == ModelKind::LatentTokens {
            let most = self.model.gaussians(0, 0);
            for s in &self.stages {
                let expected = format!("the depth of {most} Gaussians (model.latent_tokens)");
                check(1usize << s.depth == most, "stage.depth", &expected, s.depth.to_string())?;
            }
        }
        Ok(())
    }
}

impl LossConfig {
    fn check_terms(&self, estimate_channels: bool) -> Result<(), Invalid> {
        ensure(self.flow || self.seen || self.held, "loss", "at least one term", "none")?;
        ensure(
            !(self.random_patches && self.coupling == Coupling::Tree),
            "loss.random_patches",
            "false with coupling = \"tree\", which needs the tree's order",
            "true",
        )?;
        ensure((0.0..=1.0).contains(&self.unconditional), "loss.unconditional", "0 to 1", self.unconditional)?;
        ensure((0.0..=1.0).contains(&self.one_sided), "loss.one_sided", "0 to 1", self.one_sided)?;
        ensure(
            (0.0..=1.0).contains(&self.self_conditioning),
            "loss.self_conditioning",
            "0 to 1",
            self.self_conditioning,
        )?;
        ensure(
            self.self_conditioning == 0.0 || estimate_channels,
            "loss.self_conditioning",
            "0 without model.estimate_channels",
            self.self_conditioning,
        )?;
        ensure((1..=16).contains(&self.estimates), "loss.estimates", "1 to 16", self.estimates)
    }

    fn check_numbers(&self) -> Result<(), Invalid> {
        for (field, value) in [
            ("loss.frame_jitter.scale", self.frame_jitter.scale),
            ("loss.frame_jitter.center", self.frame_jitter.center),
        ] {
            ensure((0.0..=0.2).contains(&value), field, "0 to 0.2", value)?;
        }
        ensure((0.0..1.0).contains(&self.min_remaining), "loss.min_remaining", "0 to below 1", self.min_remaining)?;
        for (field, size) in [("loss.render_size", self.render_size), ("loss.gradient_size", self.gradient_size)] {
            ensure((8..=2048).contains(&size), field, "8 to 2048", size)?;
        }
        Ok(())
    }
}
