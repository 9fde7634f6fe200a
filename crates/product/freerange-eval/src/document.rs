//! A report as tables, for Markdown and for HTML alike.

use crate::{
    Report, RunFolder,
    paper::{self, thousands},
    record::style,
    report::Group,
    table::{Cell, Table, escape_html, escape_markdown},
};

/// Objects on either end that are shown.
pub const EXTREMES: usize = 5;

/// Every table of a report, in order.
pub fn tables(report: &Report) -> Vec<Table> {
    let mut out = paper::tables(report);
    out.push(summary(report));
    let names = report.metrics();
    for group in &report.groups {
        if group.measured > 0 {
            out.push(per_object(report, group, &names));
        }
    }
    let lists = [
        ("Failed", report.failures().collect::<Vec<_>>()),
        ("Skipped: these objects have no such views", report.skipped().collect()),
    ];
    for (caption, cases) in lists {
        if !cases.is_empty() {
            let mut table = Table::new(caption, &["object", "views", "inputs", "reason"]);
            table.rows = cases
                .iter()
                .map(|(c, reason)| {
                    vec![Cell::text(&c.object), Cell::text(c.views), Cell::text(c.inputs), Cell::text(reason)]
                })
                .collect();
            out.push(table);
        }
    }
    if !report.not_computed.is_empty() {
        let mut table = Table::new("Not computed", &["metric", "why"]);
        let row = |(metric, why): (&String, &String)| vec![Cell::text(style(metric).0), Cell::text(why)];
        table.rows = report.not_computed.iter().map(row).collect();
        out.push(table);
    }
    out
}

/// How a group is called.
pub fn group_name(group: &Group) -> String {
    format!("{} observation, {} inputs", group.views, group.inputs)
}

fn summary(report: &Report) -> Table {
    let names = report.metrics();
    let mut table =
        Table::new("Means over objects, with 95 % bootstrap intervals", &["input views", "objects", "failed", "#GS"]);
    table.head.extend(names.iter().map(|n| style(n).0));
    let fid = report.groups.iter().any(|g| g.fid.is_some());
    let disagreement = report.groups.iter().any(|g| g.disagreement.is_some());
    if fid {
        table.head.push("FID (images)".into());
    }
    let frechet = report.groups.iter().any(|g| g.frechet_vgg.is_some());
    if frechet {
        let unseen = "Frechet (VGG16), unseen views (images)";
        table.head.extend(["Frechet (VGG16)", "of means", unseen, "unseen, of means"].map(String::from));
    }
    if disagreement {
        table.head.push("disagreement x100".into());
    }
    table.head.extend(["s per sample".to_owned(), "peak memory MiB".to_owned()]);
    for g in report.groups.iter().filter(|g| g.measured > 0) {
        let mut row =
            vec![Cell::text(format!("{}, {}", g.views, g.inputs)), Cell::text(g.measured), Cell::text(g.failed)];
        row.push(Cell::text(thousands(g.gaussians)));
        row.extend(names.iter().map(|n| match g.metrics.get(n) {
            Some(s) => {
                let (_, factor, decimals) = style(n);
                let [mean, low, high] = [s.interval.mean, s.interval.low, s.interval.high].map(|v| factor * v);
                Cell::text(format!("{mean:.decimals$} ({low:.decimals$} to {high:.decimals$})"))
            }
            None => Cell::text("not computed"),
        }));
        if fid {
            row.push(Cell::text(g.fid.map_or("not computed".into(), |v| format!("{v:.2} ({})", g.images))));
        }
        if frechet {
            let f = g.frechet_vgg;
            let text = |value: Option<f64>| Cell::text(value.map_or("not computed".into(), |v| format!("{v:.2}")));
            row.push(text(f.map(|f| f.sample)));
            row.push(text(f.and_then(|f| f.mean)));
            let images = f.map_or(0, |f| f.unseen_images);
            let unseen = f.and_then(|f| f.unseen_sample);
            row.push(Cell::text(unseen.map_or("not computed".into(), |v| format!("{v:.2} ({images})"))));
            row.push(text(f.and_then(|f| f.unseen_mean)));
        }
        if disagreement {
            row.push(Cell::text(g.disagreement.map_or(String::new(), |v| format!("{:.3}", 100.0 * v))));
        }
        row.push(Cell::text(format!("{:.2}", g.seconds)));
        row.push(Cell::text(memory(g.peak_memory_bytes)));
        table.rows.push(row);
    }
    table
}

fn memory(bytes: Option<u64>) -> String {
    bytes.map_or("unknown".into(), |b| format!("{:.0}", b as f64 / f64::from(1 << 20)))
}

fn per_object(report: &Report, group: &Group, names: &[String]) -> Table {
    let mut table = Table::new(format!("Objects: {}", group_name(group)), &["object", "#GS"]);
    table.head.extend(names.iter().map(|n| style(n).0));
    if group.disagreement.is_some() {
        table.head.push("disagreement x100".into());
    }
    table.head.push("s per sample".into());
    for (case, m) in report.measured().filter(|(c, _)| (c.views, c.inputs) == (group.views, group.inputs)) {
        let link = m.picture.then(|| RunFolder::relative(case, "jpg"));
        let mut row = vec![Cell::link(&case.object, link), Cell::text(thousands(m.gaussians()))];
        row.extend(names.iter().map(|n| match m.metrics.get(n) {
            Some(value) => {
                let (_, factor, decimals) = style(n);
                Cell::text(format!("{:.decimals$}", factor * value))
            }
            None => Cell::text("not computed"),
        }));
        if group.disagreement.is_some() {
            row.push(Cell::text(m.disagreement.map_or(String::new(), |v| format!("{:.3}", 100.0 * v))));
        }
        row.push(Cell::text(format!("{:.2}", m.seconds)));
        table.rows.push(row);
    }
    table
}

/// What a report is of, in lines: command, machine, commits, weights.
fn facts(report: &Report) -> Vec<(&'static str, String)> {
    let e = &report.environment;
    let memory = e.memory_bytes.map_or(String::new(), |b| format!(", {:.1} GiB", b as f64 / f64::from(1 << 30)));
    let weights: Vec<String> = report.weights.iter().map(|w| format!("{} ({:.12})", w.file, w.sha256)).collect();
    let mut facts = vec![
        ("Command", e.command.clone()),
        ("Machine", format!("{}, {} threads{memory}, device {}", e.processor, e.threads, e.device)),
        ("Commit", e.commits.join(", ")),
    ];
    if !weights.is_empty() {
        facts.push(("Weights of the metrics (SHA-256 begins)", weights.join(", ")));
    }
    facts
}

/// Words that belong to every report.
const PROTOCOL: &str = "Images are compared over white at the data's own resolution, renders clamped to 0..1. A number is the mean \
over an object's validation views (and samples), then over objects. PSNR of equal images counts as 100 dB. SSIM (3DGS): 11 x 11 \
Gaussian window, zero padding, as in the 3DGS papers.";

/// The report as Markdown, to lie in the run's folder.
pub fn markdown(report: &Report) -> String {
    let mut out = format!("# Evaluation: {}\n\n", escape_markdown(&report.method));
    for (what, text) in facts(report) {
        out += &format!("- {what}: {}\n", escape_markdown(&text));
    }
    out += &format!("\n{PROTOCOL}\n\n");
    for table in tables(report) {
        out += &table.markdown();
        out.push('\n');
    }
    for group in report.groups.iter().filter(|g| g.measured > 0) {
        let (worst, best) = extremes(report, group);
        for (what, cases) in [("Worst", worst), ("Best", best)] {
            let links: Vec<String> = cases
                .iter()
                .map(|(c, m)| {
                    let name = escape_markdown(&c.object);
                    let psnr = m.metrics.get("psnr").map_or(String::new(), |v| format!(" {v:.2} dB"));
                    match m.picture {
                        true => format!("[{name}]({}){psnr}", RunFolder::relative(c, "jpg")),
                        false => format!("{name}{psnr}"),
                    }
                })
                .collect();
            if !links.is_empty() {
                out += &format!("{what} by PSNR, {}: {}\n\n", group_name(group), links.join(", "));
            }
        }
    }
    // Hostile text could close the fence: it has no line of its own in pretty JSON, whose strings hold no line breaks.
    let settings = serde_json::to_string_pretty(&report.settings).expect("plain data");
    out + &format!("Settings\n\n```json\n{settings}\n```\n")
}

type Shown<'a> = Vec<(&'a crate::record::Case, &'a crate::record::Measured)>;

/// The worst objects by PSNR, the very worst first, and the best, the very best first; no object is in both.
pub fn extremes<'a>(report: &'a Report, group: &Group) -> (Shown<'a>, Shown<'a>) {
    let mut cases = report.by_psnr(group);
    let worst_count = EXTREMES.min(cases.len().div_ceil(2));
    let rest = cases.split_off(worst_count);
    let best = rest.into_iter().rev().take(EXTREMES).collect();
    (cases, best)
}

/// The facts as an HTML list.
pub(crate) fn facts_html(report: &Report) -> String {
    let items = facts(report).into_iter().map(|(what, text)| format!("<li>{what}: {}</li>\n", escape_html(&text)));
    format!("<ul>\n{}</ul>\n<p>{PROTOCOL}</p>\n", items.collect::<String>())
}
