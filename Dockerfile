# docker build -t isac_rt . ; docker run --rm -v "$PWD:/work" isac_rt run scenes/street_canyon.yaml
FROM python:3.12-slim-bookworm
RUN apt-get update && apt-get install -y --no-install-recommends libllvm19 && rm -rf /var/lib/apt/lists/*
COPY pyproject.toml README.md LICENSE /src/
COPY isac_rt /src/isac_rt
RUN pip install --no-cache-dir "/src[cities,interchange,views]"
ENV ISAC_RT_KEPT=/tmp/isac_rt/kept NUMBA_CACHE_DIR=/tmp/isac_rt/numba MPLCONFIGDIR=/tmp/isac_rt
USER 1000
WORKDIR /work
ENTRYPOINT ["isac-rt"]
