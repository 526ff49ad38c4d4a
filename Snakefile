# From an experiment folder to its report: the rules are in vinetrack/pipeline/Snakefile.
#
#   snakemake --cores 2                               the shipped demonstration
#   snakemake --cores 2 --config experiment=PATH      a folder of one's own

from pathlib import Path


configfile: Path(workflow.basedir) / "config" / "config.yaml"


include: "vinetrack/pipeline/Snakefile"


rule everything:
    input:
        rules.all.input,
