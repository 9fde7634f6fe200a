//! `freerange eval ablations`

use std::path::PathBuf;

use freerange::{FlowConfig, Init, Options, PipelineConfig};
use freerange_eval::{
    Report, RunFolder,
    ablation::{Set, Study, Values, Variant, variants},
    runner::{Run, Shared, report},
};
use serde_json::Value;

use super::{
    args::RunArgs,
    methods::{Method, MethodName},
    verdict, work,
};
use crate::{error::CliError, ranks::Job};

/// Arguments of `eval ablations`.
#[derive(clap::Args)]
pub struct Args {
    #[command(flatten)]
    run: RunArgs,
    /// Output folder: ablations.md, ablations.json and a folder per setting, as `freerange eval` writes it.
    #[arg(short, long, value_name = "OUT")]
    output: PathBuf,
    /// Settings to vary: guidance, steps, lambda, scale, gradient, inputs [default: those that apply].
    ///
    /// All but inputs need --init flow, or a model that only samples.
    #[arg(long, value_delimiter = ',', value_name = "SETS", value_parser = set)]
    sets: Option<Vec<Set>>,
    /// Numbers of steps of the set `steps`.
    #[arg(long, value_delimiter = ',', value_name = "NUMBERS", default_value = "5,10,20,50,100")]
    step_counts: Vec<usize>,
    /// Photometric guidance scales of the set `lambda` [default: 1/4, 1/2, 2 and 4 times the default].
    #[arg(long, value_delimiter = ',', value_name = "NUMBERS")]
    lambdas: Option<Vec<f32>>,
    /// Classifier-free guidance scales of the set `scale`.
    #[arg(long, value_delimiter = ',', value_name = "NUMBERS", default_value = "1.25,1.5,2,3")]
    scales: Vec<f32>,
    /// Numbers of input views of the set `inputs`.
    #[arg(long, value_delimiter = ',', value_name = "NUMBERS", default_value = "2,4,6,9")]
    input_counts: Vec<usize>,
    /// Print the study as JSON on standard output.
    #[arg(long)]
    json: bool,
}

fn set(text: &str) -> Result<Set, String> {
    let names: Vec<&str> = Set::ALL.map(Set::name).into();
    Set::ALL.into_iter().find(|s| s.name() == text).ok_or_else(|| format!("expected one of {}", names.join(", ")))
}

/// The sets that are asked for, or all that apply to a default `pipeline`: only the flow has guidance and steps from noise,
/// and multiples of no photometric guidance are none.
fn sets(asked: Option<&[Set]>, pipeline: &PipelineConfig, lambdas: bool) -> Result<Vec<Set>, CliError> {
    let (flow, sampled) = (&pipeline.propose.flow, pipeline.propose.init == Init::Flow);
    let guided = flow.cfg_scale != 1.0 || flow.lambda_pg != 0.0;
    let applies = |set: &Set| match set {
        Set::Inputs => true,
        Set::Guidance => sampled && guided,
        Set::Lambda => sampled && (lambdas || flow.lambda_pg != 0.0),
        Set::Scale | Set::Steps | Set::Gradient => sampled,
    };
    let Some(asked) = asked else { return Ok(Set::ALL.into_iter().filter(applies).collect()) };
    let Some(set) = asked.iter().find(|set| !applies(set)) else { return Ok(asked.to_vec()) };
    let expected = match set {
        _ if !sampled => "--init flow, found initial fits, to which it means nothing",
        Set::Lambda => "--lambdas too, found multiples of the default, which is 0",
        _ => "guidance to leave out, found none in the default",
    };
    Err(CliError::input(format!("--sets {}: expected {expected}", set.name())))
}

/// The folder of the default settings.
const DEFAULT: &str = "default";

pub fn run(args: &Args, job: &Job) -> Result<(), CliError> {
    let a = &args.run;
    let inputs = args.checked_inputs()?;
    let device = job.open(a.pipeline.device)?;
    let method = a.open_method(&device)?;
    let Method::Model { model, options: default, sha256, .. } = &method else {
        return Err(CliError::failure("a model's method expected"));
    };
    // All settings are looked at before the first one is worked on.
    let planned = args.plan(default, inputs)?;
    let (shared, source) = a.open_shared(&device, job)?;
    let open = |folder: &str, options: &Options, count: usize| {
        let (model, options, sha256) = (model.clone(), Box::new(options.clone()), sha256.clone());
        let method = Method::Model { model, options, sha256, oracle: false };
        let settings = a.settings(&method, &[count], &shared, &source);
        let path = args.output.join(folder);
        let prefix = format!("{folder}: ");
        let folder = job.first_then_others(|| Ok(RunFolder::open(&path, &settings, a.overwrite && job.first())?))?;
        let method = Box::new(method);
        Ok::<_, CliError>(Run { method, folder, settings, views: a.views.sets(), inputs: vec![count], prefix })
    };
    let mut runs = vec![open(DEFAULT, default, inputs)?];
    let mut run_of = Vec::new(); // index of each variant's run
    for (variant, different) in &planned {
        run_of.push(match different {
            None => 0,
            Some((options, count)) => {
                runs.push(open(&variant.folder, options, *count)?);
                runs.len() - 1
            }
        });
    }
    job.together(work(&runs, &shared, args.json, job))?;
    if a.shard.is_some() {
        println!("this shard is done; run again without --shard for the report");
        return Ok(());
    }
    if !job.first() {
        return job.together(Ok(()));
    }
    job.together(args.report(&a.environment(&device), &runs, &shared, planned, run_of))
}

/// Options and number of inputs of a variant; none where they are the default's.
type Different = Option<(Options, usize)>;

impl Args {
    /// Whether processes that were started together share the work.
    pub fn is_shared(&self) -> bool {
        self.run.shard.is_none()
    }

    /// The number of input views, where the arguments go together.
    fn checked_inputs(&self) -> Result<usize, CliError> {
        if self.run.method != MethodName::Model {
            return Err(CliError::input("ablations are of the model: expected --method model"));
        }
        let inputs = match self.run.inputs()[..] {
            [n] => n,
            _ => {
                return Err(CliError::input("expected one number in --inputs; --input-counts holds those to compare"));
            }
        };
        match self.input_counts.iter().find(|n| !(2..=64).contains(*n)) {
            Some(n) => Err(CliError::input(format!("--input-counts: expected 2 to 64, found {n}"))),
            None => Ok(inputs),
        }
    }

    /// The variants, and in what they differ from the default.
    fn plan(&self, default: &Options, inputs: usize) -> Result<Vec<(Variant, Different)>, CliError> {
        let sets = sets(self.sets.as_deref(), &default.pipeline, self.lambdas.is_some())?;
        let multiples = || [0.25, 0.5, 2.0, 4.0].map(|factor| factor * default.pipeline.propose.flow.lambda_pg).into();
        let values = Values {
            steps: self.step_counts.clone(),
            lambda: self.lambdas.clone().unwrap_or_else(multiples),
            scale: self.scales.clone(),
            inputs: self.input_counts.clone(),
        };
        let plan = |variant: Variant| {
            let options = apply(&variant, default)?;
            let count = variant.inputs.unwrap_or(inputs);
            let same = options.pipeline == default.pipeline && count == inputs;
            Ok((variant, (!same).then_some((options, count))))
        };
        variants(&sets, &values).into_iter().map(plan).collect()
    }

    /// The reports of all runs, and the study of them.
    fn report(
        &self,
        environment: &freerange_eval::Environment,
        runs: &[Run],
        shared: &Shared,
        planned: Vec<(Variant, Different)>,
        run_of: Vec<usize>,
    ) -> Result<(), CliError> {
        let reports = runs.iter().map(|r| report(r, shared, environment)).collect::<Result<Vec<Report>, _>>()?;
        if reports[0].measured().next().is_none() {
            return verdict(&reports[..1]);
        }
        let variants = planned.into_iter().zip(run_of);
        let variants = variants.map(|((variant, _), i)| {
            let folder = if i == 0 { DEFAULT.to_owned() } else { variant.folder.clone() };
            (variant, folder, reports[i].clone())
        });
        let study = Study::new(&reports[0], variants.collect(), 0)?;
        self.write(&study, environment)?;
        verdict(&reports)
    }

    /// Writes the study into the folder and prints it.
    fn write(&self, study: &Study, environment: &freerange_eval::Environment) -> Result<(), CliError> {
        let markdown = document(study, environment);
        let write = |name: &str, text: &str| {
            let path = self.output.join(name);
            freerange_util::write_atomically(&path, |f| std::io::Write::write_all(f, text.as_bytes()))
                .map_err(|e| CliError::file(&path, e))
        };
        let json = serde_json::to_string_pretty(study).map_err(CliError::input)?;
        write("ablations.md", &markdown)?;
        write("ablations.json", &json)?;
        match self.json {
            true => println!("{json}"),
            false => println!("{markdown}\n{}", self.output.join("ablations.md").display()),
        }
        Ok(())
    }
}

/// The default with what a variant changes.
fn apply(variant: &Variant, default: &Options) -> Result<Options, CliError> {
    let refuse = |e: &dyn std::fmt::Display| CliError::input(format!("setting `{}`: {e}", variant.name));
    let value: Value = serde_json::to_value(&default.pipeline.propose.flow).map_err(|e| refuse(&e))?;
    let flow: FlowConfig = serde_json::from_value(variant.apply(&value)).map_err(|e| refuse(&e))?;
    flow.validate().map_err(|e| refuse(&e))?;
    let mut options = default.clone();
    options.pipeline.propose.flow = flow;
    Ok(options)
}

fn document(study: &Study, environment: &freerange_eval::Environment) -> String {
    use freerange_eval::table::escape_markdown;
    let mut out = format!("# Ablations at test time\n\nCommand: {}\n\n", escape_markdown(&environment.command));
    for table in study.tables() {
        out += &table.markdown();
        out.push('\n');
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sets_apply_to_the_way_of_sampling() {
        let model = freerange::internal::shipped(&freerange::Device::cpu()).unwrap();
        let fit = model.options().unwrap().pipeline;
        assert_eq!(sets(None, &fit, true).unwrap(), [Set::Inputs]);
        let mut flow = fit.clone();
        flow.propose.init = Init::Flow;
        (flow.propose.flow.cfg_scale, flow.propose.flow.lambda_pg) = (1.5, 10.0);
        assert_eq!(sets(None, &flow, false).unwrap(), Set::ALL);
        let mut plain = flow.clone();
        (plain.propose.flow.cfg_scale, plain.propose.flow.lambda_pg) = (1.0, 0.0);
        assert!(sets(None, &plain, true).unwrap().contains(&Set::Lambda));
        for (set, pipeline, word) in [
            (Set::Guidance, &plain, "guidance"),
            (Set::Lambda, &plain, "--lambdas"),
            (Set::Scale, &fit, "--init flow"),
            (Set::Steps, &fit, "--init flow"),
        ] {
            let text = sets(Some(&[Set::Inputs, set]), pipeline, false).unwrap_err().to_string();
            assert!(text.contains(word) && text.contains("--sets"), "{text}");
            assert_eq!(sets(Some(&[set]), &flow, false).unwrap(), [set]);
        }
    }
}
