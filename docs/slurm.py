"""Run an experiment on a SLURM cluster: every job is one worker that does pairs; needs `pip install dask-jobqueue`.

    python docs/slurm.py experiment.toml results --jobs 8 --cores 16 --memory 32GB --queue normal

The same command again goes on where an interrupted one stopped. The exit status is that of `lfpiv run`.
"""

import argparse
import logging
import os
import subprocess
import sys

import dask.config
from dask_jobqueue import SLURMCluster
from distributed.security import Security

import lfpiv


def main() -> int:
    """Ask SLURM for workers, do all pairs, and end the workers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("experiment", help="experiment file, where all nodes see it")
    parser.add_argument("out", help="folder for the results, where all nodes see it")
    parser.add_argument("--jobs", type=int, default=4, help="jobs of SLURM, one worker each")
    parser.add_argument("--cores", type=int, default=8, help="cores of each job")
    parser.add_argument("--memory", default="16GB", help="memory of each job; `lfpiv run` logs what a worker needs")
    parser.add_argument("--queue", help="partition of SLURM")
    parser.add_argument("--walltime", default="04:00:00", help="time of each job; a pair cut off is done again")
    parser.add_argument("--directive", action="append", default=[], help="more for sbatch: --directive=--gres=gpu:1")
    parser.add_argument("--logs", default="slurm-logs", help="folder for what the jobs say")
    arguments = parser.parse_args()
    logging.basicConfig(level=logging.INFO, format="%(asctime)s %(message)s")

    # a certificate for this run: nobody else on the network can send work, which is code, to scheduler and workers
    security = Security.temporary()
    key, certificate = security.tls_client_key, security.tls_client_cert
    tls = {"ca-file": certificate, "client.key": key, "client.cert": certificate}
    dask.config.set({f"distributed.comm.tls.{name}": value for name, value in tls.items()})
    private = os.path.join(os.path.abspath(arguments.logs), ".tls")  # files of the certificate, until the run's end
    os.makedirs(private, mode=0o700, exist_ok=True)

    with SLURMCluster(
        cores=arguments.cores,
        processes=1,
        memory=arguments.memory,
        queue=arguments.queue,
        walltime=arguments.walltime,
        job_extra_directives=arguments.directive,
        log_directory=arguments.logs,
        security=security,
        shared_temp_directory=private,
        worker_extra_args=["--nthreads", "1"],  # a worker does one pair at a time, with all cores of its job
    ) as cluster:
        # a refused job would only be a line in the log, and the run would wait for workers
        test = subprocess.run(["sbatch", "--test-only"], input=cluster.job_script(), capture_output=True, text=True)
        if test.returncode:
            print(f"SLURM refuses such a job: {test.stderr.strip()}", file=sys.stderr)
            return 2
        # for a job that ends, by its time or by scancel, another one is started; `scale` would not do so
        cluster.adapt(minimum_jobs=arguments.jobs, maximum_jobs=arguments.jobs)
        summary = lfpiv.run(arguments.experiment, arguments.out, scheduler=cluster.scheduler_address)
    for failed in summary["failed"]:
        print(f"pair {failed['pair']}: {failed['reason']}")
    return 3 if summary["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
