window.lfpivStudio = { install() {} };
