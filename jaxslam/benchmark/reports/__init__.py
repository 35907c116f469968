"""Reports of benchmarks as Markdown and HTML, with plots."""
