//! The report as one HTML file that needs nothing else: pictures are embedded, there is no script.

use base64::{Engine, engine::general_purpose::STANDARD};

use crate::{
    EvalError, Report, RunFolder,
    document::{extremes, facts_html, group_name, tables},
    record::{Case, Measured},
    table::escape_html,
};

/// No script runs and nothing is loaded, whatever the text below might say.
const HEAD: &str = "<!doctype html>\n<html lang=\"en\">\n<head>\n<meta charset=\"utf-8\">\n\
<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; img-src data:; style-src 'unsafe-inline'\">\n\
<meta name=\"viewport\" content=\"width=device-width\">\n<style>\n\
body { font: 15px/1.45 system-ui, sans-serif; margin: 2em auto; max-width: 75em; padding: 0 1em; color: #222; background: #fff }\n\
table { border-collapse: collapse; margin: 1.5em 0; font-variant-numeric: tabular-nums; display: block; overflow-x: auto }\n\
caption { text-align: left; font-weight: 600; margin-bottom: .4em }\n\
td, th { padding: .15em .7em; border-bottom: 1px solid #ddd; text-align: right; white-space: nowrap }\n\
td:first-child, th:first-child { text-align: left }\n\
figure { margin: 1em 0 } img { max-width: 100%; border: 1px solid #ddd } pre { background: #f5f5f5; padding: 1em; overflow-x: auto }\n\
</style>\n";

/// Which picture strips a report holds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Embed {
    /// Those of the worst and the best objects of each group.
    Extremes,
    /// Those of all objects.
    All,
}

/// The report as HTML. `folder` holds the picture strips; the others are linked there.
///
/// # Errors
/// [`EvalError::Io`] where a picture strip cannot be read.
pub fn html(report: &Report, folder: &RunFolder, embed: Embed) -> Result<String, EvalError> {
    let title = escape_html(&format!("Evaluation: {}", report.method));
    let mut out = format!("{HEAD}<title>{title}</title>\n</head>\n<body>\n<h1>{title}</h1>\n{}", facts_html(report));
    for table in tables(report) {
        out += &table.html();
    }
    for group in report.groups.iter().filter(|g| g.measured > 0) {
        out += &format!("<h2>{}</h2>\n", escape_html(&group_name(group)));
        let cases = report.by_psnr(group);
        let psnr: Vec<f64> = cases.iter().filter_map(|(_, m)| m.metrics.get("psnr").copied()).collect();
        out += &histogram(&psnr, "PSNR in dB", "objects");
        out += "<p>Picture strips, from top to bottom: input views; validation views; renders; error (white none, black half \
                the range or more).</p>\n";
        let lists = match embed {
            Embed::All => vec![("All objects, the worst first", cases)],
            Embed::Extremes => {
                let (worst, best) = extremes(report, group);
                vec![("Worst objects", worst), ("Best objects", best)]
            }
        };
        for (what, cases) in lists.into_iter().filter(|(_, cases)| !cases.is_empty()) {
            out += &format!("<h3>{what}</h3>\n");
            for (case, measured) in cases {
                out += &figure(case, measured, folder)?;
            }
        }
    }
    let settings = serde_json::to_string_pretty(&report.settings).expect("plain data");
    // Line by line, since escaping takes control characters for spaces.
    let settings: Vec<String> = settings.lines().map(escape_html).collect();
    Ok(out + &format!("<h2>Settings</h2>\n<pre>{}</pre>\n</body>\n</html>\n", settings.join("\n")))
}

fn figure(case: &Case, measured: &Measured, folder: &RunFolder) -> Result<String, EvalError> {
    let psnr = measured.metrics.get("psnr").map_or(String::new(), |v| format!(", {v:.2} dB"));
    let caption = escape_html(&format!("{}{psnr}", case.object));
    let picture = if measured.picture { folder.picture(case)? } else { None };
    let image = picture.map_or(String::new(), |bytes| {
        format!("<img alt=\"{caption}\" src=\"data:image/jpeg;base64,{}\">", STANDARD.encode(bytes))
    });
    Ok(format!("<figure><figcaption>{caption}</figcaption>{image}</figure>\n"))
}

/// A histogram as inline SVG: bins of a whole number (or a simple fraction) of units, at most about twenty.
pub fn histogram(values: &[f64], label: &str, of: &str) -> String {
    let (least, most) = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), &v| (a.min(v), b.max(v)));
    if values.is_empty() || !least.is_finite() || !most.is_finite() {
        return String::new();
    }
    let width = [0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0]
        .into_iter()
        .find(|w| (most - least) / w <= 20.0)
        .unwrap_or((most - least) / 20.0);
    let first = (least / width).floor();
    let bins = ((most / width).floor() - first) as usize + 1;
    let mut counts = vec![0usize; bins];
    values.iter().for_each(|v| counts[((v / width).floor() - first) as usize] += 1);
    let highest = counts.iter().copied().max().unwrap_or(1).max(1);
    let (bar, height) = (32, 160);
    let mut out = format!(
        "<svg xmlns=\"http://www.w3.org/2000/svg\" width=\"{}\" height=\"{}\" role=\"img\" font-size=\"11\" \
         font-family=\"sans-serif\">\n",
        bins * bar + 20,
        height + 56
    );
    for (i, count) in counts.iter().enumerate() {
        let (x, h) = (10 + i * bar, count * height / highest);
        out += &format!(
            "<rect x=\"{x}\" y=\"{}\" width=\"{}\" height=\"{h}\" fill=\"#4a7ab5\"/>\n",
            16 + height - h,
            bar - 2
        );
        if *count > 0 {
            out += &format!(
                "<text x=\"{}\" y=\"{}\" text-anchor=\"middle\">{count}</text>\n",
                x + bar / 2 - 1,
                12 + height - h
            );
        }
        let decimals = if width < 1.0 { 1 } else { 0 };
        let from = (first + i as f64) * width;
        out += &format!("<text x=\"{x}\" y=\"{}\">{from:.decimals$}</text>\n", 30 + height);
    }
    let text = escape_html(&format!("{label}, {} {of}", values.len()));
    out + &format!("<text x=\"10\" y=\"{}\">{text}</text>\n</svg>\n", 48 + height)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_value_is_in_one_bar() {
        let values = [10.0, 10.4, 12.9, 12.99, 31.0];
        let svg = histogram(&values, "PSNR <dB>", "objects");
        let counts = svg.lines().filter_map(|l| l.split("middle\">").nth(1)?.split('<').next()?.parse::<usize>().ok());
        assert_eq!(counts.clone().sum::<usize>(), values.len());
        assert_eq!(counts.collect::<Vec<_>>(), [2, 2, 1]); // bins of 2 dB: 10, 12, 30
        assert!(svg.contains("&lt;dB&gt;") && svg.contains(">10<") && svg.contains(">30<"));
        assert_eq!(histogram(&[], "a", "b"), "");
        assert_eq!(histogram(&[f64::NAN, f64::INFINITY], "a", "b"), "");
        assert!(histogram(&[5.0], "a", "b").contains("<rect"));
    }
}
