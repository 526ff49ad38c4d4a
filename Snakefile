# From an experiment folder to its report. The rules are in vinetrack/pipeline/Snakefile.
#
#   snakemake --cores 2                               the shipped demonstration
#   snakemake --cores 2 --config experiment=PATH      your own experiment

from pathlib import Path


configfile: Path(workflow.basedir) / "config" / "config.yaml"


include: "vinetrack/pipeline/Snakefile"


onstart:  # Snakemake takes hooks from this file alone
    atexit.register(or_exit(begin_run, plan.results, plan.experiment).release)


onerror:
    atexit.unregister(print_report_path)


rule everything:
    input:
        rules.all.input,
