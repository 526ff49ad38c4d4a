# From an experiment folder to its report. Rules only: what they need to know is in vinetrack/pipeline/workflow.py.
#
#   snakemake --cores 2                               the shipped demonstration
#   snakemake --cores 2 --config experiment=PATH      a folder of one's own

from pathlib import Path

from vinetrack.figures.registry import FIGURES
from vinetrack.pipeline.stage_code import code_hash
from vinetrack.pipeline.workflow import plan_or_stop, say_where_at_exit, shell_prefix


configfile: Path(workflow.basedir) / "config" / "config.yaml"


shell.prefix(shell_prefix())
plan = plan_or_stop(config, Path(workflow.basedir))
say_where_at_exit(plan, quiet=workflow.dryrun)


rule all:
    input:
        plan.result("report.html"),
        plan.result("provenance.json"),


if plan.nature:

    rule laboratory:
        """Make what the sheet of a shipped experiment names, once, in the virtual laboratory."""
        input:
            plan.sheets,
        output:
            plan.measurements,
        log:
            plan.result("logs", "laboratory.log"),
        threads: 4  # scaled down to the cores that are given
        params:
            code=code_hash("laboratory"),
            folder=plan.experiment,
            nature=plan.nature,
        shell:
            "python -m vinetrack.laboratory {params.folder:q} --nature {params.nature:q} --processes {threads} 2>&1"
            " | tee {log:q}"


rule recording:
    """One recording, from its file to its motion."""
    input:
        lambda wildcards: plan.filmed[wildcards.trial],
    output:
        plan.result("tracks", "{trial}.csv"),
        plan.result("kinematics", "{trial}.csv"),
        plan.result("analysed", "{trial}.json"),
        [
            report(
                plan.result("figures", f"strip_{{trial}}.{form}"),
                caption=FIGURES["strip"].caption_file,
                category="Recordings",
                labels={"trial": "{trial}", "format": form},
            )
            for form in plan.settings.figures.formats
        ],
    log:
        plan.result("logs", "recording_{trial}.log"),
    wildcard_constraints:
        trial=plan.one_of(plan.filmed),
    params:
        code=code_hash("recording"),
        unwatched=plan.unwatched,
        experiment=plan.experiment,
        results=plan.results,
        settings=plan.stage_settings(
            "steady",
            "velocity",
            "final_at_fraction",
            "efficiency_at_mm",
            "figures",
        ),
    shell:
        "vinetrack recording {params.experiment:q} {wildcards.trial:q} {params.results:q}"
        " --settings {params.settings:q} --log {log:q}"


rule tracks:
    """All trials that come as tracks, in one job: a process takes longer to start than a track takes to analyse."""
    input:
        plan.track_inputs,
    output:
        plan.per_trial("tracks", ".csv", plan.tracked),
        plan.per_trial("kinematics", ".csv", plan.tracked),
        plan.per_trial("analysed", ".json", plan.tracked),
    log:
        plan.result("logs", "tracks.log"),
    threads: 32  # scaled down to the cores that are given
    params:
        code=code_hash("tracks"),
        unwatched=plan.unwatched,
        experiment=plan.experiment,
        results=plan.results,
        settings=plan.stage_settings(
            "steady", "velocity", "final_at_fraction", "efficiency_at_mm"
        ),
    shell:
        "vinetrack tracks {params.experiment:q} {params.results:q} --settings {params.settings:q}"
        " --threads {threads} --log {log:q}"


rule gather:
    """What every trial gave, as the tables of the experiment."""
    input:
        plan.sheets,
        plan.per_trial("analysed", ".json"),
    output:
        plan.result("trials.csv"),
        plan.result("conditions.csv"),
        plan.result("steady.csv"),
        plan.result("damping_points.csv"),
    log:
        plan.result("logs", "gather.log"),
    params:
        code=code_hash("gather"),
        experiment=plan.experiment,
        results=plan.results,
        settings=plan.stage_settings("final_at_fraction", "efficiency_at_mm"),
    shell:
        "vinetrack gather {params.experiment:q} {params.results:q} --settings {params.settings:q} --log {log:q}"


rule damping:
    """The damping law, its intervals, and how damping, speed and efficiency go with size."""
    input:
        plan.result("damping_points.csv"),
        plan.result("conditions.csv"),
    output:
        plan.result("damping.json"),
        plan.result("scaling.json"),
    log:
        plan.result("logs", "damping.log"),
    params:
        code=code_hash("damping"),
        results=plan.results,
        settings=plan.stage_settings("damping"),
    shell:
        "vinetrack damping {params.results:q} --settings {params.settings:q} --log {log:q}"


rule model:
    """The model in use fitted to all trajectories, held against them, and audited for what it leaves out."""
    input:
        plan.sheets,
        plan.own_effects,
        plan.per_trial("tracks", ".csv"),
        plan.per_trial("kinematics", ".csv"),
        plan.result("damping.json"),
    output:
        plan.result("fit.json"),
        plan.result("comparison.csv"),
        plan.result("model_check.csv"),
        plan.result("audit.csv"),
        plan.result("payload_model.csv"),
        directory(plan.result("comparison")),
    log:
        plan.result("logs", "model.log"),
    params:
        code=code_hash("model"),
        unwatched=plan.unwatched,
        experiment=plan.experiment,
        results=plan.results,
        settings=plan.stage_settings("final_at_fraction"),
    shell:
        "vinetrack model {params.experiment:q} {params.results:q} --settings {params.settings:q} --log {log:q}"


rule diagnosis:
    """What the model in use lacks; added, while it is one effect, with the errors before and after."""
    input:
        plan.sheets,
        plan.own_effects,
        plan.per_trial("tracks", ".csv"),
        plan.per_trial("kinematics", ".csv"),
    output:
        plan.result("diagnosis.json"),
        plan.result("ladder.csv"),
        directory(plan.result("diagnosis")),
    log:
        plan.result("logs", "diagnosis.log"),
    params:
        code=code_hash("diagnosis"),
        unwatched=plan.unwatched,
        experiment=plan.experiment,
        results=plan.results,
        settings=plan.stage_settings("steady", "velocity", "damping"),
    shell:
        "vinetrack diagnosis {params.experiment:q} {params.results:q} --settings {params.settings:q} --log {log:q}"


rule trial_figures:
    """Position, speed and steady stretches of every trial."""
    input:
        plan.per_trial("tracks", ".csv"),
        plan.per_trial("kinematics", ".csv"),
        plan.result("steady.csv"),
    output:
        [
            report(
                path,
                caption=FIGURES["trial_motion"].caption_file,
                category="Trials",
                labels={"trial": trial, "format": form},
            )
            for trial, form, path in plan.trial_figures()
        ],
    log:
        plan.result("logs", "trial_figures.log"),
    threads: 32  # scaled down to the cores that are given
    params:
        code=code_hash("figures"),
        experiment=plan.experiment,
        results=plan.results,
        settings=plan.stage_settings("figures"),
    shell:
        "vinetrack figures {params.experiment:q} {params.results:q} --of trials --settings {params.settings:q}"
        " --threads {threads} --log {log:q}"


rule campaign_figures:
    """The damping law, its numbers, its scale, and all trials at a glance."""
    input:
        plan.per_trial("kinematics", ".csv"),
        plan.result("trials.csv"),
        plan.result("damping_points.csv"),
        plan.result("damping.json"),
        plan.result("scaling.json"),
        plan.result("comparison.csv"),
        plan.result("comparison"),
        plan.result("conditions.csv"),
        plan.result("payload_model.csv"),
        plan.result("fit.json"),
        plan.result("diagnosis.json"),
        plan.result("ladder.csv"),
        plan.result("diagnosis"),
    output:
        plan.figure_list,  # the figures that have content, which nobody knows beforehand
    log:
        plan.result("logs", "campaign_figures.log"),
    params:
        code=code_hash("figures"),
        experiment=plan.experiment,
        results=plan.results,
        settings=plan.stage_settings("figures"),
    shell:
        "vinetrack figures {params.experiment:q} {params.results:q} --of campaign --settings {params.settings:q}"
        " --log {log:q}"


if plan.published:

    rule paper:
        """The paper's numbers and figures beside those of this experiment."""
        input:
            plan.sheets,
            plan.per_trial("kinematics", ".csv"),
            plan.result("steady.csv"),
            plan.result("conditions.csv"),
            plan.result("damping_points.csv"),
            plan.result("damping.json"),
            plan.result("scaling.json"),
            plan.result("fit.json"),
        output:
            plan.paper_tables,
            [
                report(
                    path,
                    caption=FIGURES[name].caption_file,
                    category=FIGURES[name].category,
                    labels={"figure": FIGURES[name].label, "format": form},
                )
                for name, form, path in plan.paper_figures()
            ],
        log:
            plan.result("logs", "paper.log"),
        params:
            code=code_hash("paper"),
            experiment=plan.experiment,
            results=plan.results,
            settings=plan.stage_settings("figures"),
        shell:
            "vinetrack paper {params.experiment:q} {params.results:q} --settings {params.settings:q} --log {log:q}"


if plan.clips:

    rule overlays:
        """Recordings slowed down, with the tracked edge and the edges that the models predict."""
        input:
            [path for paths in plan.filmed.values() for path in paths],
            plan.per_trial("tracks", ".csv", plan.filmed),
            plan.per_trial("analysed", ".json", plan.filmed),
            plan.result("trials.csv"),
            plan.result("fit.json"),
            plan.result("diagnosis.json"),
            plan.result("diagnosis"),
        output:
            report(
                directory(plan.result("overlays")),
                patterns=["{trial}.mp4"],
                caption=FIGURES["overlay"].caption_file,
                category="Clips",
                labels={"trial": "{trial}"},
            ),
        log:
            plan.result("logs", "overlays.log"),
        threads: 32  # scaled down to the cores that are given
        params:
            code=code_hash("overlays"),
            experiment=plan.experiment,
            results=plan.results,
            settings=plan.stage_settings("overlays"),
        shell:
            "vinetrack overlays {params.experiment:q} {params.results:q} --settings {params.settings:q}"
            " --threads {threads} --log {log:q}"


rule report_page:
    """Everything a person wants to see, in one file, and what it was made with."""
    input:
        plan.inputs,
        plan.figure_files(),
        plan.paper_tables,
        plan.clips,
        plan.result("steady.csv"),
        plan.result("fit.json"),
        plan.result("diagnosis.json"),
        plan.result("ladder.csv"),
        plan.result("comparison.csv"),
        plan.result("model_check.csv"),
    output:
        plan.result("report.html"),
        plan.result("provenance.json"),
    log:
        plan.result("logs", "report.log"),
    params:
        code=code_hash("report"),
        experiment=plan.experiment,
        results=plan.results,
        settings=plan.stage_settings(),
    shell:
        "vinetrack report {params.experiment:q} {params.results:q} --settings {params.settings:q} --log {log:q}"
