//! Two reports of the same data, object by object.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::{
    EvalError, Report,
    record::{Case, Measured, ViewSet, higher_is_better, ordered, style},
    statistics::{Interval, bootstrap},
    table::{Cell, Table},
};

/// What changes from report A to report B, for the objects of one view set that have numbers in both.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Comparison {
    /// From where the inputs look.
    pub views: ViewSet,
    /// Number of input views in A and in B.
    pub inputs: [usize; 2],
    /// Objects with numbers in both.
    pub objects: usize,
    /// Objects with numbers in A alone.
    pub only_a: Vec<String>,
    /// Objects with numbers in B alone.
    pub only_b: Vec<String>,
    /// The metrics that both have, and seconds.
    pub metrics: Vec<Paired>,
    /// FID of A and of B, where both measured the same objects.
    pub fid: Option<[f64; 2]>,
}

/// How a metric changes from A to B.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Paired {
    /// Its name, or `seconds`.
    pub metric: String,
    /// Mean in A.
    pub a: f64,
    /// Mean in B.
    pub b: f64,
    /// Mean of the differences B - A, with the 95 % bootstrap interval over objects.
    pub difference: Interval,
    /// Objects for which B is better.
    pub better: usize,
    /// Objects for which B is worse.
    pub worse: usize,
    /// Objects that are equal in both.
    pub equal: usize,
}

impl Paired {
    /// Objects that are compared.
    pub fn objects(&self) -> usize {
        self.better + self.worse + self.equal
    }
}

type Key = (ViewSet, usize, String);

/// Compares two reports. Cases are paired by object, view set and number of inputs; where each report has but one number
/// of inputs, by object and view set.
///
/// # Errors
/// [`EvalError::Incomparable`] where no object is in both, or an object was scored by other images or cameras.
pub fn compare(a: &Report, b: &Report, seed: u64) -> Result<Vec<Comparison>, EvalError> {
    let single = |r: &Report| {
        let mut inputs: Vec<usize> = r.measured().map(|(c, _)| c.inputs).collect();
        inputs.sort_unstable();
        inputs.dedup();
        inputs.len() == 1
    };
    let by_object = single(a) && single(b);
    let key = |c: &Case| -> Key { (c.views, if by_object { 0 } else { c.inputs }, c.object.clone()) };
    let index = |r: &'_ Report| -> BTreeMap<Key, (Case, Measured)> {
        r.measured().map(|(c, m)| (key(c), (c.clone(), m.clone()))).collect()
    };
    let (of_a, of_b) = (index(a), index(b));
    let mut kinds: Vec<(ViewSet, usize)> = of_a.keys().filter(|k| of_b.contains_key(*k)).map(|k| (k.0, k.1)).collect();
    kinds.dedup();
    if kinds.is_empty() {
        return Err(EvalError::Incomparable("no object, view set and number of inputs has numbers in both".into()));
    }
    let mut out = Vec::new();
    for (views, inputs) in kinds {
        let own = |k: &&Key| (k.0, k.1) == (views, inputs);
        let missing = |from: &BTreeMap<Key, (Case, Measured)>, other: &BTreeMap<Key, (Case, Measured)>| {
            from.keys().filter(own).filter(|k| !other.contains_key(*k)).map(|k| k.2.clone()).collect::<Vec<_>>()
        };
        let (only_a, only_b) = (missing(&of_a, &of_b), missing(&of_b, &of_a));
        let mut pairs = Vec::new();
        for (k, (case, first)) in of_a.iter().filter(|(k, _)| own(k)) {
            let Some((other, second)) = of_b.get(k) else { continue };
            if first.validation_sha256 != second.validation_sha256 {
                let problem = "was scored by other validation images or cameras";
                return Err(EvalError::Incomparable(format!("`{}` ({views}) {problem}", k.2)));
            }
            pairs.push((case.inputs, other.inputs, first, second));
        }
        let group = |r: &Report, inputs: usize| {
            r.groups.iter().find(|g| (g.views, g.inputs) == (views, inputs)).and_then(|g| g.fid)
        };
        let inputs = [pairs[0].0, pairs[0].1];
        let fid = match only_a.is_empty() && only_b.is_empty() {
            true => group(a, inputs[0]).zip(group(b, inputs[1])).map(|(a, b)| [a, b]),
            false => None,
        };
        let pairs: Vec<(&Measured, &Measured)> = pairs.into_iter().map(|(_, _, a, b)| (a, b)).collect();
        out.push(Comparison {
            views,
            inputs,
            objects: pairs.len(),
            only_a,
            only_b,
            metrics: paired(&pairs, seed),
            fid,
        });
    }
    Ok(out)
}

fn paired(pairs: &[(&Measured, &Measured)], seed: u64) -> Vec<Paired> {
    let seconds = "seconds".to_owned();
    let mut names = ordered(pairs.iter().flat_map(|(a, _)| a.metrics.keys()));
    names.push(seconds.clone());
    let value = |m: &Measured, name: &String| match *name == seconds {
        true => Some(m.seconds),
        false => m.metrics.get(name).copied(),
    };
    let compare = |metric: String| {
        let values: Vec<(f64, f64)> =
            pairs.iter().map(|(a, b)| value(a, &metric).zip(value(b, &metric))).collect::<Option<_>>()?;
        let differences: Vec<f64> = values.iter().map(|(a, b)| b - a).collect();
        let sign = if higher_is_better(&metric) == Some(false) { -1.0 } else { 1.0 };
        let count = |wanted: fn(f64) -> bool| differences.iter().filter(|d| wanted(sign * **d)).count();
        let n = values.len() as f64;
        Some(Paired {
            a: values.iter().map(|v| v.0).sum::<f64>() / n,
            b: values.iter().map(|v| v.1).sum::<f64>() / n,
            difference: bootstrap(&differences, seed)?,
            better: count(|d| d > 0.0),
            worse: count(|d| d < 0.0),
            equal: count(|d| d == 0.0),
            metric,
        })
    };
    names.into_iter().filter_map(compare).collect()
}

/// One table per view set.
pub fn tables(comparisons: &[Comparison]) -> Vec<Table> {
    comparisons
        .iter()
        .map(|c| {
            let inputs = match c.inputs {
                [a, b] if a == b => format!("{a} inputs"),
                [a, b] => format!("{a} inputs in A, {b} in B"),
            };
            let mut caption = format!("{} observation, {inputs}, {} objects", c.views, c.objects);
            for (name, objects) in [("A", &c.only_a), ("B", &c.only_b)] {
                if !objects.is_empty() {
                    caption += &format!("; in {name} alone: {}", objects.join(", "));
                }
            }
            let head = ["metric", "A", "B", "B - A", "95 % interval", "B better", "B worse", "equal"];
            let mut table = Table::new(caption, &head);
            for m in &c.metrics {
                let (label, factor, decimals) = style(&m.metric);
                let number = |v: f64| Cell::text(format!("{:.decimals$}", factor * v));
                let signed = |v: f64| format!("{:+.decimals$}", factor * v);
                let d = m.difference;
                table.rows.push(vec![
                    Cell::text(label),
                    number(m.a),
                    number(m.b),
                    Cell::text(signed(d.mean)),
                    Cell::text(format!("{} to {}", signed(d.low), signed(d.high))),
                    Cell::text(m.better),
                    Cell::text(m.worse),
                    Cell::text(m.equal),
                ]);
            }
            if let Some([a, b]) = c.fid {
                let mut row = vec![Cell::text("FID"), Cell::text(format!("{a:.2}")), Cell::text(format!("{b:.2}"))];
                row.push(Cell::text(format!("{:+.2}", b - a)));
                row.extend(std::iter::repeat_with(|| Cell::text("")).take(4));
                table.rows.push(row);
            }
            table
        })
        .collect()
}
