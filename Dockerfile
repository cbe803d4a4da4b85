# lfpiv on a cluster: docker build -t lfpiv . && docker run --rm -v "$PWD:/data" lfpiv run experiment.toml --out results
# With a GPU, add --gpus all. By Apptainer: apptainer build lfpiv.sif docker-daemon://lfpiv:latest
FROM python:3.12-slim AS build
WORKDIR /source
COPY pyproject.toml README.md LICENSE ./
COPY lfpiv lfpiv
COPY lfpiv_kernels lfpiv_kernels
RUN pip wheel --no-cache-dir --no-deps --wheel-dir /wheels .

FROM python:3.12-slim
COPY --from=build /wheels /wheels
RUN pip install --no-cache-dir "$(ls /wheels/lfpiv-*.whl)[distributed]" \
    && useradd --uid 1000 --create-home lfpiv \
    && rm -r /wheels
USER 1000
# Kernels are compiled at the first run and kept here; mount a folder on it to keep them for the next container.
ENV XDG_CACHE_HOME=/tmp/lfpiv-cache
WORKDIR /data
ENTRYPOINT ["lfpiv"]
CMD ["--help"]
